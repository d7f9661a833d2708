"""An inpainting diffusion model as stages 2 and 3 use it. `sd2` and `mini` differ in what is loaded, not in code."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import adaptive_max_pool2d

from ihbench.diffusion.crops.push_pull import push_pull


class LatentAutoencoder:
    """Stable Diffusion's AutoencoderKL behind `encode` and `decode`, with its scaling factor."""

    def __init__(self, vae: Any):
        self.vae = vae
        self.scaling = float(vae.config.scaling_factor)
        self.channels = int(vae.config.latent_channels)
        self.block = 2 ** (len(vae.config.block_out_channels) - 1)

    def encode(self, images: Tensor) -> Tensor:
        """[B, 3, H, W] in [-1, 1] -> the mean latents: one image always gives the same."""
        return self.vae.encode(images.to(self.vae.dtype)).latent_dist.mode() * self.scaling

    def decode(self, latents: Tensor) -> Tensor:
        return self.vae.decode((latents / self.scaling).to(self.vae.dtype)).sample


@dataclass
class Backbone:
    """The parts, all in eval mode and frozen; personalisation adds to them.

    `unet` takes 2 C + 1 channels (noisy latents, mask, latents of the masked image) and gives C; `controlnet` takes
    C channels and the part map, that of `mini` also what other
    frames show of the surface. `size` is the height in px of the crops it was trained on.
    """

    name: str
    unet: Any
    text_encoder: Any
    tokenizer: Any
    controlnet: Any
    codec: Any  # BlockTransform or LatentAutoencoder
    scheduler: Any  # DDIM
    size: int
    square: bool  # trained on squares only
    prefill: bool = False  # trained with hidden pixels of the masked image filled by push-pull instead of grey
    heads: bool = False  # trained on head crops, too

    @property
    def device(self) -> torch.device:
        return next(self.unet.parameters()).device

    @property
    def dtype(self) -> torch.dtype:
        return next(self.unet.parameters()).dtype

    @property
    def max_tokens(self) -> int:
        return int(self.text_encoder.config.max_position_embeddings)

    def token_ids(self, prompts: list[str]) -> Tensor:
        """[B, L] padded to the text encoder's length, or in a small vocabulary to what it was trained on."""
        return padded_ids(self.tokenizer, prompts, self.max_tokens).to(self.device)

    def text(self, prompts: list[str]) -> Tensor:
        """[B, L, D] hidden states of the prompts, with gradients to whatever of the encoder is trained."""
        return self.text_of(self.token_ids(prompts))

    def text_of(self, ids: Tensor) -> Tensor:
        """`text` of prompts that are token ids already."""
        return self.text_encoder(ids).last_hidden_state

    def condition(
        self,
        images: Tensor,  # [B, 3, H, W] in [-1, 1]
        hidden: Tensor,  # [B, 1, H, W] 1 where the model is to paint
        person: Tensor | None = None,  # [B, 1, H, W] 1 where a pixel is known to show the person
        fill: Tensor | None = None,  # [B, 3, H, W] in [-1, 1] what hidden pixels begin with
    ) -> Tensor:
        """[B, 1 + C, h, w]: the mask, and the latents of the masked image (diffusers' order). Its hidden pixels are
        grey, or with `prefill` carry `fill`, and without one the colours of the person around them."""
        masked = images * (hidden < 0.5)
        if self.prefill and fill is None and person is not None:
            fill = push_pull(images, person * (hidden < 0.5))
        if self.prefill and fill is not None:
            masked = masked + fill * (hidden >= 0.5)
        masked = self.codec.encode(masked)
        return torch.cat([shrink_mask(hidden, masked), masked], 1).to(self.dtype)

    def predict(
        self,
        noisy: Tensor,  # [B, C, h, w]
        timesteps: Tensor,  # [B]
        condition: Tensor,  # [B, 1 + C, h, w]
        text: Tensor,  # [B, L, D]
        guide: Tensor | None,  # [B, 3 or 7, H, W] in [0, 1], of which the ControlNet takes as many as it knows;
        # None leaves it out
        *,
        control_text: Tensor | None = None,  # [B, L, D] what the ControlNet is told; None: the same as the UNet
        control_scale: float = 1.0,  # of what the ControlNet adds
        guess: bool = False,  # diffusers' guess mode: from a tenth of it at the finest level to all at the coarsest
    ) -> Tensor:
        """What the scheduler's `prediction_type` says: noise, velocity or the clean latents."""
        noisy = noisy.to(self.dtype)  # the autoencoder may be kept in fp32
        residuals: dict[str, Tensor | list[Tensor]] = {}
        if guide is not None:
            guide = guide[:, : self.controlnet.config.conditioning_channels].to(self.dtype)
            down, middle = self.controlnet(
                noisy, timesteps, encoder_hidden_states=text if control_text is None else control_text,
                controlnet_cond=guide, conditioning_scale=control_scale, guess_mode=guess, return_dict=False,
            )  # fmt: skip
            residuals = {"down_block_additional_residuals": down, "mid_block_additional_residual": middle}
        return self.unet(torch.cat([noisy, condition], 1), timesteps, encoder_hidden_states=text, **residuals).sample

    def target(self, latents: Tensor, noise: Tensor, timesteps: Tensor) -> Tensor:
        """What `predict` should have said."""
        kind = self.scheduler.config.prediction_type
        if kind == "sample":
            return latents
        if kind == "v_prediction":
            return self.scheduler.get_velocity(latents, noise, timesteps)
        return noise

    def snr(self, timesteps: Tensor) -> Tensor:
        """[B] signal-to-noise ratio at timesteps."""
        kept = self.scheduler.alphas_cumprod.to(timesteps.device)[timesteps]
        return kept / (1 - kept)


def padded_ids(tokenizer: Any, prompts: list[str], length: int) -> Tensor:
    """[B, length] token ids, cut or padded."""
    words = tokenizer(prompts, padding="max_length", truncation=True, max_length=length, return_tensors="pt")
    return words.input_ids


def shrink_mask(mask: Tensor, latents: Tensor) -> Tensor:
    """[B, 1, H, W] -> [B, 1, h, w] of the latents: a block with any marked pixel is marked."""
    return adaptive_max_pool2d(mask.float(), latents.shape[-2:])
