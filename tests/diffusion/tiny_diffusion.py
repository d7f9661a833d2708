"""A backbone of `mini`'s classes that is small enough for tests, and crops of a person to personalise it to."""

from __future__ import annotations

from unittest.mock import patch

import numpy as np
import torch

from ihbench.diffusion.backbone import Backbone
from ihbench.diffusion.crops.crop_view import CropView, cut_view
from ihbench.diffusion.mini import model as mini_model
from ihbench.scene.contracts import MaskState, TrainView
from tests.bench.fake_capture import the_body
from tests.methods.tiny_fit import training_views

WORDS = ("a", "photo", "of", "person", "with", "skin")
CROP = 32  # px


def tiny_backbone(seed: int = 0) -> Backbone:
    with patch.object(mini_model, "CHANNELS", (32, 32, 32)), patch.object(mini_model, "SIZE", CROP):
        backbone = mini_model.new_mini(WORDS, seed)
    with torch.no_grad():  # an untrained ControlNet says nothing: its last layers are zero
        generator = torch.Generator().manual_seed(seed + 1)
        for p in backbone.controlnet.parameters():
            if not p.any():
                p += 0.05 * torch.randn(p.shape, generator=generator)
    for part in (backbone.unet, backbone.controlnet, backbone.text_encoder):
        part.eval().requires_grad_(False)
    return backbone


def crops(hide: slice | None = None) -> list[CropView]:
    """Six views of the tiny person; `hide` makes these columns of every view unknown."""
    out = []
    for k, view in enumerate(training_views()):
        mask = view.mask.copy()
        if hide is not None:
            mask[:, hide] = MaskState.UNKNOWN
        shown = TrainView(view.image, mask, view.camera, view.body_pose, view.frame, view.camera_id)
        out.append(cut_view(shown, k, the_body(), CROP))
    return out


def weights(module: torch.nn.Module) -> dict[str, torch.Tensor]:
    return {name: value.detach().clone() for name, value in module.state_dict().items()}


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def images_equal(a: list[np.ndarray], b: list[np.ndarray]) -> bool:
    return len(a) == len(b) and all((x == y).all() for x, y in zip(a, b, strict=True))
