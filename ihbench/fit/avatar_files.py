"""What a fitted avatar leaves on disk: `avatar.safetensors`, the parameters and persistent buffers of a module, and
`avatar.json`, what they belong to."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor, nn

from ihbench.body import Body
from ihbench.errors import BadInput

Config = Any  # of a method: a frozen dataclass


def write_avatar(
    folder: Path,
    kind: str,  # of the avatar: the method's name
    module: nn.Module,
    config: Config,
    body: Body,
    betas: NDArray[np.float64] | None = None,
    **more: object,  # what else the module needs to be itself; JSON-able
) -> None:
    """Enough to make the avatar again beside the same body. Raises `BadInput` when the disk does not take it."""
    from safetensors.torch import save

    from ihbench.files.atomic import write_bytes, write_json

    state = {name: value.detach().cpu().contiguous() for name, value in module.state_dict().items()}
    write_bytes(folder / "avatar.safetensors", save(state))
    words = {"kind": kind, "config": asdict(config), "body": body.content_sha(), **more}
    if betas is not None:
        words["betas"] = betas.tolist()
    write_json(folder / "avatar.json", words)


@dataclass(frozen=True)
class SavedAvatar:
    """What `write_avatar` wrote."""

    words: Mapping[str, Any]
    tensors: dict[str, Tensor]
    folder: Path

    @contextmanager
    def put_together(self) -> Iterator[None]:
        """What goes wrong inside, while a module is made of these files, is `BadInput` in one line."""
        try:
            yield
        except (BadInput, AttributeError, KeyError, TypeError, ValueError, RuntimeError) as error:
            raise BadInput(
                f"{self.folder}: avatar.json and avatar.safetensors do not belong together or to this version "
                f"({type(error).__name__}: {str(error).splitlines()[0]}); fit again"
            ) from error


def read_avatar(folder: Path, kind: str, body: Body) -> SavedAvatar:
    """Raises `BadInput` for a missing or foreign file and for another body."""
    from safetensors import SafetensorError
    from safetensors.torch import load

    from ihbench.files.atomic import read_json
    from ihbench.files.regular import read_bytes

    try:
        words = read_json(folder / "avatar.json")
        tensors = load(read_bytes(folder / "avatar.safetensors"))
    except (BadInput, ValueError, KeyError, SafetensorError) as error:
        raise BadInput(f"{folder}: no readable avatar there: {error}") from error
    own = words.get("kind") if isinstance(words, dict) else None
    if own != kind:
        raise BadInput(f"{folder}: holds an avatar of kind {own!r}, expected {kind!r}")
    fitted, given = words.get("body"), body.content_sha()
    if fitted != given:
        raise BadInput(f"{folder}: was fitted on another body ({fitted}) than the one given ({given})")
    return SavedAvatar(words, tensors, folder)
