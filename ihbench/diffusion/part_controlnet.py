"""A fresh ControlNet for the part map, made from a UNet: a copy of its encoder whose outputs start at zero.

`ControlNetModel.from_unet` copies `in_channels` and `conv_in`, so a nine-channel inpainting UNet would give a
ControlNet that does not take the four-channel latents it is fed. From such a UNet everything is copied but `conv_in`,
of which the channels of the noisy latents are kept (the first of the nine; that is our choice).
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import torch

COPIED = ("time_embedding", "down_blocks", "mid_block")


def new_controlnet(unet: Any, channels: int, device: torch.device, dtype: torch.dtype, seed: int = 0) -> Any:
    """A ControlNet for latents of `channels` channels, in eval mode and frozen.

    `unet` takes `channels` channels, or more of which the first are the noisy latents. The new layers (part map to
    features) are drawn on the CPU from `seed`; no other random state is touched.
    """
    from diffusers import ControlNetModel
    from diffusers.configuration_utils import FrozenDict

    shape = SimpleNamespace(config=FrozenDict({**unet.config, "in_channels": channels}))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        controlnet: Any = ControlNetModel.from_unet(shape, load_weights_from_unet=False)  # type: ignore[arg-type]
    for part in COPIED:
        getattr(controlnet, part).load_state_dict(getattr(unet, part).state_dict())
    with torch.no_grad():
        controlnet.conv_in.weight.copy_(unet.conv_in.weight[:, :channels])
        controlnet.conv_in.bias.copy_(unet.conv_in.bias)
    # ModelMixin.to warns at every change of type, of modules to be kept in float32, of which there are none
    return torch.nn.Module.to(controlnet, device, dtype).eval().requires_grad_(False)
