"""The `mini` backbone on disk: a folder in diffusers' layout, in half precision. One comes with the package."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from ihbench.errors import BadInput
from ihbench.methods.inpainthuman.inpainting.backbone import Backbone
from ihbench.methods.inpainthuman.inpainting.block_transform import BlockTransform
from ihbench.methods.inpainthuman.inpainting.mini_model import SIZE
from ihbench.methods.inpainthuman.inpainting.quiet_libraries import quiet_libraries

SHIPPED = Path(__file__).parent / "mini"
PARTS = ("unet", "controlnet", "text_encoder", "tokenizer", "codec", "scheduler")


def save_mini(backbone: Backbone, folder: Path) -> None:
    """Write the folder. Weights are rounded to 16 bit."""
    for name in ("unet", "controlnet", "text_encoder", "codec"):
        part = getattr(backbone, name)
        kind = torch.float32 if name == "codec" else torch.float16
        # rounded and put back: a copy would take along whatever hooks a training has on the module
        original = {key: value.detach().clone() for key, value in part.state_dict().items()}
        with quiet_libraries():  # parts that like float32 complain of being rounded
            part.to(kind).save_pretrained(folder / name, safe_serialization=True)
        part.to(torch.float32)
        part.load_state_dict(original)
    backbone.tokenizer.save_pretrained(folder / "tokenizer")
    backbone.scheduler.save_pretrained(folder / "scheduler")


def check_mini(folder: Path) -> Path:
    """The folder, if it has every part."""
    folder = Path(folder).expanduser()
    missing = [name for name in PARTS if not (folder / name).is_dir()]
    if missing:
        raise BadInput(
            f"{folder}: not a mini backbone, lacks {', '.join(missing)}; `ihbench train-mini --out DIR` makes one"
        )
    return folder


def load_mini(folder: Path | None = None, device: str = "cpu") -> Backbone:
    """The shipped backbone, or one that `ihbench train-mini` wrote. Raises `BadInput` for another folder."""
    folder = check_mini(SHIPPED if folder is None else folder)
    from diffusers import ControlNetModel, DDIMScheduler, UNet2DConditionModel
    from transformers import AutoTokenizer, CLIPTextModel

    given: dict[str, Any] = {"local_files_only": True, "use_safetensors": True, "torch_dtype": torch.float32}
    try:
        with quiet_libraries():
            backbone = Backbone(
                name="mini",
                unet=UNet2DConditionModel.from_pretrained(folder / "unet", **given),
                text_encoder=CLIPTextModel.from_pretrained(
                    folder / "text_encoder", local_files_only=True, use_safetensors=True
                ).float(),
                tokenizer=AutoTokenizer.from_pretrained(folder / "tokenizer", local_files_only=True),
                controlnet=ControlNetModel.from_pretrained(folder / "controlnet", **given),
                codec=BlockTransform.from_pretrained(folder / "codec", **given),
                scheduler=DDIMScheduler.from_pretrained(folder / "scheduler"),
                size=SIZE,
                square=False,
                prefill=True,
            )
    except Exception as error:  # whatever a damaged file makes of four libraries' readers
        words = str(error).splitlines()
        raise BadInput(
            f"{folder}: not a readable mini backbone ({words[0] if words else type(error).__name__})"
        ) from error
    for name in ("unet", "controlnet", "text_encoder", "codec"):
        part = getattr(backbone, name).to(device).eval().requires_grad_(False)
        if not all(torch.isfinite(value).all() for value in part.state_dict().values()):
            raise BadInput(f"{folder}/{name}: holds weights that are not finite; train it again")
    return backbone
