"""The `mini` backbone on disk: a folder in diffusers' layout, in half precision. One comes with the package."""

from __future__ import annotations

import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from ihbench.diffusion.backbone import Backbone
from ihbench.diffusion.checkpoint import UnreadModule, empty_module, readable
from ihbench.diffusion.mini.folder import SHIPPED, STEMS, check_mini
from ihbench.diffusion.mini.model import SIZE
from ihbench.diffusion.quiet_libraries import quiet_libraries
from ihbench.diffusion.text_encoder import unread_text_encoder
from ihbench.errors import BadInput
from ihbench.files import atomic

HEADS = "heads"  # of the ControlNet's configuration: whether it knows the guide of head crops


def save_mini(backbone: Backbone, folder: Path) -> None:
    """Write the folder, each file whole or not at all. Weights are rounded to 16 bit."""
    with TemporaryDirectory() as spare:
        _save(backbone, Path(spare))
        for path in sorted(path for path in Path(spare).rglob("*") if path.is_file()):
            atomic.write_bytes(folder / path.relative_to(spare), path.read_bytes())


def _save(backbone: Backbone, folder: Path) -> None:
    for name in ("unet", "controlnet", "text_encoder", "codec"):
        part = getattr(backbone, name)
        kind = torch.float32 if name == "codec" else torch.float16
        # rounded and put back: a copy would take along whatever hooks a training has on the module
        original = {key: value.detach().clone() for key, value in part.state_dict().items()}
        with quiet_libraries():  # parts that like float32 complain of being rounded
            part.to(kind).save_pretrained(folder / name, safe_serialization=True)
            part.to(torch.float32)
        part.load_state_dict(original)
    if backbone.heads:
        config = folder / "controlnet" / "config.json"
        config.write_text(json.dumps(json.loads(config.read_text()) | {HEADS: True}, indent=2, sort_keys=True) + "\n")
    backbone.tokenizer.save_pretrained(folder / "tokenizer")
    backbone.scheduler.save_pretrained(folder / "scheduler")


def load_mini(folder: Path | None = None, device: str = "cpu") -> Backbone:
    """The shipped backbone, or one that `ihbench train-mini` wrote, frozen. Raises `BadInput` for another folder, and
    for weights that are damaged, missing, superfluous or not finite: none is made up."""
    root, configs = check_mini(SHIPPED if folder is None else folder)
    heads = configs["controlnet"].pop(HEADS, False) is True  # the library would complain of a word of ours
    from diffusers import ControlNetModel, DDIMScheduler, UNet2DConditionModel

    from ihbench.diffusion.mini.block_transform import BlockTransform

    place = torch.device(device)

    def part(name: str, kind: Any) -> Any:
        module = empty_module(root / name, lambda: kind.from_config(configs[name]))
        return UnreadModule(module, root / name, STEMS[name]).read(place, torch.float32)

    tokenizer = mini_tokenizer(root)
    known = configs["text_encoder"].get("vocab_size")
    if not isinstance(known, int) or len(tokenizer) > known:
        raise BadInput(
            f"{root / 'tokenizer'}: {len(tokenizer)} words, but the text encoder has {known}; take both from one "
            f"training"
        )
    with readable(f"{root / 'scheduler'}: not a readable part of a mini backbone"):
        scheduler: Any = DDIMScheduler.from_pretrained(root / "scheduler")
    return Backbone(
        name="mini",
        unet=part("unet", UNet2DConditionModel),
        text_encoder=unread_text_encoder(root / "text_encoder", configs["text_encoder"]).read(place, torch.float32),
        tokenizer=tokenizer,
        controlnet=part("controlnet", ControlNetModel),
        codec=part("codec", BlockTransform),
        scheduler=scheduler,
        size=SIZE,
        square=False,
        prefill=True,
        heads=heads,
    )


def mini_tokenizer(folder: Path) -> Any:
    """The tokenizer of a folder that `check_mini` has looked at. Raises `BadInput` for a damaged one."""
    from transformers import AutoTokenizer

    with readable(f"{folder / 'tokenizer'}: not a readable part of a mini backbone"):
        return AutoTokenizer.from_pretrained(folder / "tokenizer", local_files_only=True)
