"""Score distillation: what a frozen diffusion model would change about an image, as that image's gradient.

    z   = E(image)                                    with its gradient (DreamFusion, Poole et al., ICLR 2023)
    z_t = √ᾱ z + √(1-ᾱ) ε                             ε given, ᾱ of the scheduler at timestep t
    ε̂   = ε_neg + s (ε_pos - ε_neg)                   s the guidance; 0 and 1 take one prediction instead of two
    g   = w(t) (ε̂ - ε),   L = ½ Σ m (z - stop(z - g))²,   ∂L/∂z = m g

Sums, not means, over batch, channels and pixels. A model that predicts clean latents or velocity gives the same g
through x̂₀: (ε̂ - ε) = √ᾱ / √(1-ᾱ) (z - x̂₀); guidance is affine, so it may be applied to whatever is predicted.

Both methods that distil call `ScoreDistillation`:

    OccFusion   ScoreDistillation(backbone, guidance=0.0)(images, Prompts(positive, negative), falling_timestep(r), ε,
                guide=part_guide(parts), weight=mask); guidance 0: of the prompts only the negative one counts
    GTU         ScoreDistillation(backbone, guidance=50.0, control_scale=0.7)(images,
                Prompts(positive, negative, control), drawn_timestep(low, high, generator), ε,
                guide=part_guide(parts, seen)), where `control` is the prompt without the person's own word. For what
                other views have seen of the surface, pass `condition=backbone.condition(known, hidden, person)`

and then `.loss.backward()`. `images` are [B, 3, H, W] in [-1, 1] at the size the model shall see, resized by the
caller; ε has the shape that `latent_shape` gives. Which views are drawn, and a step's noise, are the method's own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ihbench.diffusion.backbone import Backbone
from ihbench.diffusion.crops.diffusion_batch import guide_of

Factor = Callable[[Tensor], Tensor]  # [B] ᾱ -> [B] w


def noise_share(kept: Tensor) -> Tensor:
    """w = 1 - ᾱ: of DreamFusion, and of both released codes (OccFusion guidance/op_utils.py; GTU
    controlnet_guidance.py)."""
    return 1 - kept


@dataclass(frozen=True)
class Prompts:
    """What the model is told."""

    positive: str
    negative: str = ""
    control: str | None = None  # what the ControlNet is told beside the positive prompt; None: the same


@dataclass(frozen=True)
class Distilled:
    """`loss` has the gradient; the others are for looking at."""

    loss: Tensor  # scalar
    gradient: Tensor  # [B, C, h, w] of the loss by the latents: m g
    clean: Tensor  # [B, C, h, w] x̂₀, what the model takes the latents for


class ScoreDistillation:
    """A frozen backbone's gradient for images. Holds no state but the prompts it has read: what is drawn is given."""

    def __init__(
        self, backbone: Backbone, *, guidance: float, control_scale: float = 1.0, factor: Factor = noise_share
    ):
        self.backbone, self.guidance, self.control_scale, self.factor = backbone, guidance, control_scale, factor
        self._read: dict[str, Tensor] = {}

    def latent_shape(self, height: int, width: int) -> tuple[int, int, int]:
        """Of the noise for an image of this size in px."""
        codec = self.backbone.codec
        return codec.channels, height // codec.block, width // codec.block

    def __call__(
        self,
        images: Tensor,  # [B, 3, H, W] in [-1, 1], with the gradient of what is learned
        prompts: Prompts,
        timestep: int | Tensor,  # one for all, or [B]; 0 to 999
        noise: Tensor,  # [C, h, w] or [B, C, h, w], standard normal
        *,
        guide: Tensor | None = None,  # [B, 7, H, W] of `part_guide`; None leaves the ControlNet out
        condition: Tensor | None = None,  # [B, 1 + C, h, w] of `Backbone.condition`; None: nothing is known
        weight: Tensor | None = None,  # [B, 1, h, w] m; None: 1 everywhere
    ) -> Distilled:
        """The loss whose gradient is what the model would change. Where the model's answer is not finite the gradient
        is 0, as released."""
        backbone = self.backbone
        latents = backbone.codec.encode(images).float()
        times = torch.as_tensor(timestep, device=latents.device, dtype=torch.int64).expand(len(latents))
        kept = backbone.scheduler.alphas_cumprod.to(latents.device, torch.float32)[times][:, None, None, None]
        z = latents.detach()
        with torch.no_grad():
            noise = noise.to(z).expand_as(z)
            noisy = kept.sqrt() * z + (1 - kept).sqrt() * noise
            condition = self.nothing_known(images) if condition is None else condition
            predicted = self._predict(noisy, times, condition, prompts, guide)
            error, clean = _error_and_clean(
                backbone.scheduler.config.prediction_type, predicted, z, noisy, noise, kept
            )
            gradient = self.factor(kept.flatten())[:, None, None, None] * error
            gradient = torch.where(gradient.isfinite(), gradient, torch.zeros_like(gradient))
            pull = gradient if weight is None else gradient * weight.to(gradient)
        # ½ m (z - stop(z - g))², written so that a g far smaller than z is not rounded away
        loss = ((latents - z) * pull).sum() + (gradient * pull).sum() / 2
        return Distilled(loss, pull, clean)

    def nothing_known(self, images: Tensor) -> Tensor:
        """[B, 1 + C, h, w]: all is to be painted and nothing of the image is shown. Else an inpainting model would
        copy what it sees, and the gradient would vanish."""
        hidden = torch.ones_like(images[:, :1])
        return self.backbone.condition(torch.zeros_like(images).to(self.backbone.dtype), hidden)

    def _predict(
        self, noisy: Tensor, times: Tensor, condition: Tensor, prompts: Prompts, guide: Tensor | None
    ) -> Tensor:
        def said(prompt: str, control: str | None) -> Tensor:
            count = len(noisy)
            return self.backbone.predict(
                noisy, times, condition, self._text(prompt, count), guide,
                control_text=None if control is None else self._text(control, count),
                control_scale=self.control_scale,
            ).float()  # fmt: skip

        if self.guidance == 0:
            return said(prompts.negative, None)
        positive = said(prompts.positive, prompts.control)
        if self.guidance == 1:
            return positive
        return torch.lerp(said(prompts.negative, None), positive, self.guidance)

    def _text(self, prompt: str, count: int) -> Tensor:
        if prompt not in self._read:
            self._read[prompt] = self.backbone.text([prompt])
        return self._read[prompt].expand(count, -1, -1)


def part_guide(parts: Tensor, seen: Tensor | None = None) -> Tensor:
    """[B, 7, H, W] for the ControlNet, of a part map [B, 3, H, W] in [0, 1] (`part_colours`) and of what other views
    show [B, 4, H, W]: RGB in [0, 1], and 1 there; None: nothing."""
    return guide_of(parts, parts.new_zeros(len(parts), 4, *parts.shape[2:]) if seen is None else seen)


def falling_timestep(progress: float, low: int = 20, high: int = 980, last: int = 1000) -> int:
    """OccFusion's: from `high` at progress 0 to `low` at 1, in step with the fit."""
    return min(max(round((1 - progress) * last), low), high)


def drawn_timestep(low: float, high: float, generator: torch.Generator, last: int = 1000) -> int:
    """GTU's: uniform among the whole numbers of [low · last, high · last], at most last - 1."""
    first, end = (min(round(share * last), last - 1) for share in (low, high))
    return int(torch.randint(first, end + 1, (1,), generator=generator))


def _error_and_clean(
    kind: str, predicted: Tensor, z: Tensor, noisy: Tensor, noise: Tensor, kept: Tensor
) -> tuple[Tensor, Tensor]:
    """ε̂ - ε and x̂₀ of what a model predicts."""
    signal, spread = kept.sqrt(), (1 - kept).sqrt()
    if kind == "epsilon":
        error = predicted - noise
        return error, z - spread / signal * error
    clean = predicted if kind == "sample" else signal * noisy - spread * predicted
    return signal / spread * (z - clean), clean
