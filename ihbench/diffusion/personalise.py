"""Stage 2, personalisation (sec. 3.3): a word for the person, then an inpainter adapted to them.

Both learn from pixels whose truth is known: M_train = M_vis ⊙ M_rand. The model is asked to paint visible pixels that
`random_mask` hid, and the loss looks at these alone, so that the real occluder is never learned as content.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.diffusion.backbone import Backbone, shrink_mask
from ihbench.diffusion.crops.crop_view import CropView
from ihbench.diffusion.crops.diffusion_batch import batch_of, by_width, guide_of
from ihbench.diffusion.crops.push_pull import push_pull
from ihbench.diffusion.crops.random_mask import SHARES, random_mask
from ihbench.diffusion.inpaint_config import InpaintConfig
from ihbench.diffusion.subject_token import ANYBODY, SubjectToken
from ihbench.diffusion.tuning import Tuning, trainable
from ihbench.errors import BadInput

TI_SHARES = (0.25, 0.05, 0.05, 0.05, 0.10, 0.50)  # kinds of masks: mostly everything: the word must say it
SEEN_KEPT = 0.5  # share of the crops of the adaptation that are given what other frames show of what they paint
BACKGROUND_WEIGHT = 0.15  # of blocks without the person
TEXT_LR = 1e-5  # of LoRA on the text encoder
LEAST_FRAMES = 4
TI_STATE, ADAPT_STATE = "stage2-ti", "stage2-adapt"
ATTENTION = ["to_q", "to_k", "to_v", "to_out.0"]
TEXT_ATTENTION = ["q_proj", "k_proj", "v_proj", "out_proj"]


class Personaliser(Tuning):
    """Personalises a backbone in place."""

    def __init__(
        self, backbone: Backbone, views: list[CropView], config: InpaintConfig, seed: int, ledger: Ledger
    ) -> None:
        shown = [view for view in views if view.person.any()]
        if not shown:
            raise BadInput("personalisation: no frame shows a visible pixel of the person; nothing to learn from")
        super().__init__(backbone, seed, ledger)
        self.views, self.config, self.settled = shown, config, config.settled()
        self.token: SubjectToken | None = None

    @property
    def prompt(self) -> str:
        return self.token.prompt if self.token is not None else ANYBODY

    def run(self, progress: Progress, adapt: bool = True) -> None:
        """Learn the word, then adapt; each only when its switch is on."""
        config = self.config
        if config.ti:
            with self.ledger.stage("textual-inversion"):
                self._invert(progress)
        if adapt and (config.lora or config.sg):
            with self.ledger.stage("adapt"):
                self._adapt(progress)

    def _invert(self, progress: Progress) -> None:
        config = self.config
        self.token = token = SubjectToken(self.backbone, config.token, self.settled.vectors)
        named: dict[str, nn.Parameter] = {"vectors": token.vectors}
        rates = {"vectors": self.settled.ti_lr}
        if config.text_lora:
            added = self._with_lora(self.backbone.text_encoder, TEXT_ATTENTION, "text", TI_STATE)
            named |= added
            rates |= {name: TEXT_LR for name in added}
        best = best_seen(self.views, config.ti_frames)
        # with the part map, when there is one at inference: the word need not learn the pose
        self._optimise(
            TI_STATE, "textual inversion", named, rates, config.ti_steps, best, TI_SHARES, config.sg, progress
        )
        for p in named.values():
            p.requires_grad_(False)

    def _adapt(self, progress: Progress) -> None:
        config, backbone = self.config, self.backbone
        named: dict[str, nn.Parameter] = {}
        rates: dict[str, float] = {}
        if config.lora:
            if self.settled.tune == "lora":
                added = self._with_lora(backbone.unet, ATTENTION, "unet", ADAPT_STATE)
            else:
                backbone.unet.requires_grad_(True)
                added = trainable(backbone.unet, "unet")
            named |= added
            rates |= {name: self.settled.lora_lr for name in added}
        if config.sg:
            backbone.controlnet.requires_grad_(True)
            added = trainable(backbone.controlnet, "controlnet")
            named |= added
            rates |= {name: self.settled.control_lr for name in added}
        self._optimise(
            ADAPT_STATE, "adapting", named, rates, config.lora_steps, self.views, SHARES, config.sg, progress
        )
        for p in named.values():
            p.requires_grad_(False)

    def _with_lora(self, module: nn.Module, targets: list[str], prefix: str, state: str) -> dict[str, nn.Parameter]:
        """Put LoRA of the configured rank into a frozen module. It starts from the run's seed alone, whatever else
        has drawn random numbers. Its parameters, by name."""
        from peft import LoraConfig, inject_adapter_in_model

        rank = self.config.rank
        lora = LoraConfig(r=rank, lora_alpha=rank, target_modules=targets, init_lora_weights="gaussian")
        with torch.random.fork_rng(devices=[]):  # peft draws on the CPU
            torch.manual_seed(int(np.random.default_rng((self.seed, *state.encode())).integers(2**62)))
            inject_adapter_in_model(lora, module)
        return trainable(module, prefix)

    def _optimise(
        self,
        state: str,
        what: str,
        named: dict[str, nn.Parameter],
        rates: dict[str, float],
        steps: int,
        views: list[CropView],
        shares: tuple[float, ...],
        use_parts: bool,
        progress: Progress,
    ) -> None:
        self._tune(
            state, what, named, rates, steps, self.config.batch,
            lambda rng, batch: self.loss(views, rng, batch, shares, use_parts), progress,
        )  # fmt: skip

    def loss(
        self, views: list[CropView], rng: np.random.Generator, batch: int, shares: tuple[float, ...], use_parts: bool
    ) -> Tensor | None:
        """Denoising loss over visible pixels hidden on purpose; None when the draw hid none of them."""
        backbone = self.backbone
        chosen = draw(views, rng, batch)
        crops = batch_of(chosen, backbone.device)
        made_up = np.stack(
            [random_mask(rng, view.body if view.body.any() else view.person, shares) for view in chosen]
        )
        hidden = torch.from_numpy(made_up).to(backbone.device)[:, None].float()
        # where nothing else shows the surface, the model (or in textual inversion the word) must know it
        kept = np.zeros(len(chosen)) if shares is TI_SHARES else rng.random(len(chosen)) < SEEN_KEPT
        kept = torch.from_numpy(kept).to(hidden)[:, None, None, None]
        guide = guide_of(crops.parts, crops.seen * torch.maximum(1 - hidden, kept)) if use_parts else None
        generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
        with torch.no_grad():
            # behind the real occluder the surroundings go on: its paint must not reach the model as noisy content
            beyond = push_pull(crops.pixels, 1 - crops.unknown)
            pixels = torch.where(crops.unknown > 0, beyond, crops.pixels).to(self.dtype)
            latents = backbone.codec.encode(pixels)
            condition = backbone.condition(pixels, torch.maximum(hidden, crops.unknown), crops.person)
            weight = shrink_mask(hidden, latents) * (1 - shrink_mask(crops.unknown, latents))
            weight = weight * (BACKGROUND_WEIGHT + (1 - BACKGROUND_WEIGHT) * shrink_mask(crops.person, latents))
            if not weight.any():
                return None
            noise = torch.randn(latents.shape, generator=generator).to(latents)
            last = backbone.scheduler.config.num_train_timesteps
            timesteps = torch.randint(0, last, (len(chosen),), generator=generator).to(backbone.device)
            noisy = backbone.scheduler.add_noise(latents, noise, timesteps)
        with torch.autocast(backbone.device.type, self.dtype, enabled=self.dtype != torch.float32):
            text = backbone.text([self.prompt]).expand(len(chosen), -1, -1)
            predicted = backbone.predict(noisy, timesteps, condition, text, guide)
        error = (predicted - backbone.target(latents, noise, timesteps)).float().square()
        per_crop = (error * channel_weight(backbone) * weight).sum((1, 2, 3)) / weight.sum((1, 2, 3)).clamp(min=1)
        return (per_crop / latents.shape[1] * timestep_weight(backbone, timesteps)).mean()


def best_seen(views: list[CropView], share: float) -> list[CropView]:
    """The views in which the least of the body is hidden; at least four, as far as there are so many."""
    count = min(len(views), max(LEAST_FRAMES, round(share * len(views))))
    order = sorted(range(len(views)), key=lambda k: (views[k].hidden_share, k))
    return [views[k] for k in sorted(order[:count])]


def channel_weight(backbone: Backbone) -> Tensor | float:
    """How much an error in each latent channel matters. A block transform knows its channels' share of the pixels."""
    scale = getattr(backbone.codec, "scale", None)
    if scale is None:
        return 1.0
    weight = scale**1.5
    return (weight / weight.mean())[:, None, None]


def timestep_weight(backbone: Backbone, timesteps: Tensor) -> Tensor:
    """Clean-latent models are weighted by their clipped signal-to-noise ratio; the others as they were trained."""
    if backbone.scheduler.config.prediction_type != "sample":
        return torch.ones(len(timesteps), device=timesteps.device)
    return backbone.snr(timesteps).clamp(1, 5)


def draw(views: list[CropView], rng: np.random.Generator, batch: int) -> list[CropView]:
    """A batch of one crop width, in proportion to how many views have it."""
    groups = by_width(views)
    widths = list(groups)
    counts = np.array([len(groups[w]) for w in widths], np.float64)
    numbers = groups[widths[int(rng.choice(len(widths), p=counts / counts.sum()))]]
    return [views[k] for k in rng.choice(numbers, batch, replace=len(numbers) < batch)]
