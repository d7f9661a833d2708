"""A model part on disk: a folder with `config.json` and safetensors, checked by their headers before they are read.

Found under a stem such as `diffusion_pytorch_model`: `<stem>.safetensors`, `<stem>.fp16.safetensors` (or bf16), or
shards listed in `<stem>.safetensors.index.json`. Pickles are never opened. Nothing is downloaded: a hub id is looked
up in the local Hugging Face cache.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from ihbench.diffusion.quiet_libraries import quiet_libraries
from ihbench.errors import BadInput
from ihbench.files.paths import user_path
from ihbench.files.regular import read_text

PICKLES = (".bin", ".ckpt", ".pt", ".pth", ".pkl")
VARIANTS = ("", ".fp16", ".bf16")
HUB_ID = re.compile(r"[\w][\w.-]*/[\w][\w.-]*")
FLOATS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
CONVERT = "convert them elsewhere: load with diffusers, then save_pretrained(folder, safe_serialization=True)"

Rename = Callable[[str], str | None]


def find_folder(where: str, option: str) -> Path:
    """The folder itself, or the cached snapshot of a hub id. `option` is what the user set, for the message."""
    folder = user_path(where, option)
    if folder.is_dir():
        return folder
    if folder.is_file():
        raise BadInput(
            f"{option} {where}: a single file; expected a folder in diffusers layout (parts with config.json and "
            f"safetensors); {CONVERT}"
        )
    if not HUB_ID.fullmatch(where):
        raise BadInput(f"{option} {where}: no such folder; give a folder in diffusers layout, or a cached hub id")
    from huggingface_hub import constants, snapshot_download
    from huggingface_hub.errors import HFValidationError, LocalEntryNotFoundError

    try:
        return Path(snapshot_download(where, local_files_only=True))
    except (LocalEntryNotFoundError, HFValidationError) as error:
        raise BadInput(
            f"{option} {where}: neither a folder nor a hub id in the local Hugging Face cache "
            f"({constants.HF_HUB_CACHE}); the bench downloads nothing: fetch it with `hf download {where}`, or give "
            f"the folder of a copy"
        ) from error


Config = dict[str, Any]  # of a model of diffusers or transformers, as they write it


def read_json(path: Path) -> Config:
    try:
        content = json.loads(read_text(path, "a JSON file"))
    except (BadInput, ValueError, RecursionError) as error:
        raise BadInput(f"{path}: not readable as JSON ({_line(error)}); fetch this file again") from error
    if not isinstance(content, dict):
        raise BadInput(f"{path}: expected a JSON object, found {type(content).__name__}; fetch this file again")
    return content


def weight_files(folder: Path, stem: str) -> list[Path]:
    """The safetensors of a part; several when sharded; none when there are none. Raises `BadInput` for shards that
    are missing or lie elsewhere."""
    for variant in VARIANTS:
        path = folder / f"{stem}{variant}.safetensors"
        if path.is_file():
            return [path]
    for variant in VARIANTS:
        # diffusers has written the variant in either place
        for name in (f"{stem}.safetensors.index{variant}.json", f"{stem}{variant}.safetensors.index.json"):
            if (folder / name).is_file():
                return _shards(folder / name)
    return []


def has_pickles(folder: Path) -> bool:
    return folder.is_dir() and any(path.suffix in PICKLES for path in folder.iterdir())


def _shards(index: Path) -> list[Path]:
    table = read_json(index).get("weight_map")
    if not isinstance(table, dict) or not table:
        raise BadInput(f"{index}: expected a weight_map of tensor names to files; fetch this file again")
    names = sorted({str(name) for name in table.values()})
    outside = [name for name in names if Path(name).name != name or not name.endswith(".safetensors")]
    if outside:
        raise BadInput(f"{index}: expected names of safetensors beside it, found {outside[0]!r}")
    lacking = [name for name in names if not (index.parent / name).is_file()]
    if lacking:
        raise BadInput(f"{index}: lists {', '.join(lacking)}, which {index.parent} lacks; fetch the missing files")
    return [index.parent / name for name in names]


def empty_module(folder: Path, build: Callable[[], Any]) -> Any:
    """A module with parameters on the meta device. Raises `BadInput` when the library rejects its configuration."""
    from accelerate import init_empty_weights

    with readable(f"{folder / 'config.json'}: not a usable configuration"), init_empty_weights(include_buffers=False):
        return build()


@contextmanager
def readable(otherwise: str) -> Iterator[None]:
    """Turns whatever a damaged file makes of the libraries inside into a `BadInput` that begins with `otherwise`."""
    try:
        with quiet_libraries():
            yield
    except Exception as error:  # all sorts
        raise BadInput(f"{otherwise} ({_line(error)}); fetch it again") from error


class UnreadModule:
    """A module whose tensors are still on disk; names and shapes are known to fit.

    `module` has its parameters on the meta device. `rename` turns a stored name into the module's, or None for a
    tensor that is not needed. Raises `BadInput` for a file that is cut short or no safetensors, and for tensors that
    are missing, superfluous or of another shape: none is ever made up.
    """

    def __init__(self, module: nn.Module, folder: Path, stem: str, rename: Rename = lambda name: name):
        self.module, self.folder, self.files = module, folder, weight_files(folder, stem)
        if not self.files:
            why = f"only pickles, which are refused; {CONVERT}" if has_pickles(folder) else "no such file"
            raise BadInput(f"{folder}: expected {stem}.safetensors, found {why}")
        self.names: dict[str, tuple[Path, str]] = {}  # module's name -> file, stored name
        shapes: dict[str, tuple[int, ...]] = {}
        for file in self.files:
            for stored, shape in _header(file).items():
                name = rename(stored)
                if name is not None:
                    self.names[name], shapes[name] = (file, stored), shape
        expected = {name: tuple(tensor.shape) for name, tensor in module.state_dict().items()}
        faults = []
        if missing := [name for name in expected if name not in shapes]:
            faults.append(f"{len(missing)} of {len(expected)} tensors are missing ({missing[0]})")
        if extra := [name for name in shapes if name not in expected]:
            faults.append(f"{len(extra)} are not of this model ({extra[0]})")
        if wrong := [name for name in expected if name in shapes and shapes[name] != expected[name]]:
            name = wrong[0]
            faults.append(f"{len(wrong)} have another shape ({name} is {[*shapes[name]]}, not {[*expected[name]]})")
        if faults:
            raise BadInput(
                f"{self.folder}: the weights do not fit config.json: {'; '.join(faults)}; fetch both from one source"
            )

    def read(self, device: torch.device, dtype: torch.dtype) -> Any:
        """The module with its weights, in eval mode and frozen. Raises `BadInput` for weights that are not finite."""
        from safetensors import SafetensorError, safe_open

        state: dict[str, Tensor] = {}
        for file in self.files:
            try:
                with safe_open(file, "pt") as tensors:
                    for name, (place, stored) in self.names.items():
                        if place == file:
                            state[name] = _checked(tensors.get_tensor(stored), file, stored, device, dtype)
            except (OSError, SafetensorError) as error:
                raise _unreadable(file, error) from error
        self.module.load_state_dict(state, assign=True)
        # for what is not stored; diffusers' own `to` warns of modules to be kept in float32, of which there are none
        return nn.Module.to(self.module, device).eval().requires_grad_(False)


def _checked(tensor: Tensor, file: Path, name: str, device: torch.device, dtype: torch.dtype) -> Tensor:
    if tensor.dtype not in FLOATS:
        raise BadInput(f"{file}: {name} is stored as {tensor.dtype}; expected fp16, bf16 or fp32 weights")
    out = tensor.to(device, dtype, copy=True)  # a copy, so that the file may change or go
    if not torch.isfinite(out).all():
        if torch.isfinite(tensor).all():
            raise BadInput(f"{file}: {name} has values too large for {dtype}; use float32")
        raise BadInput(f"{file}: {name} has NaN or infinite values; fetch this file again")
    return out


def _header(file: Path) -> dict[str, tuple[int, ...]]:
    """Shapes by name. Reads no tensor, but a file that is cut short is found."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(file, "pt") as tensors:
            return {name: tuple(tensors.get_slice(name).get_shape()) for name in tensors.keys()}  # noqa: SIM118
    except (OSError, SafetensorError) as error:
        raise _unreadable(file, error) from error


def _unreadable(file: Path, error: Exception) -> BadInput:
    with file.open("rb") as stream:
        pointer = stream.read(40).startswith(b"version https://git-lfs")
    if pointer:
        return BadInput(f"{file}: a Git LFS pointer, not the weights; run `git lfs pull` in its repository")
    return BadInput(f"{file}: not a whole safetensors file ({_line(error)}); fetch it again")


def _line(error: Exception) -> str:
    return next(iter(str(error).strip().splitlines()), type(error).__name__)
