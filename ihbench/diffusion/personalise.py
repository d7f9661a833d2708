"""Stage 2, personalisation (sec. 3.3): a word for the person, then an inpainter adapted to them.

Both learn from pixels whose truth is known: M_train = M_vis ⊙ M_rand. The model is asked to paint visible pixels that
`random_mask` hid, and the loss looks at these alone, so that the real occluder is never learned as content.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from ihbench.clock.events import Resumed, RolledBack, Warned
from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.diffusion.backbone import Backbone, shrink_mask
from ihbench.diffusion.crops.crop_view import CropView
from ihbench.diffusion.crops.diffusion_batch import batch_of, by_width, guide_of
from ihbench.diffusion.crops.push_pull import push_pull
from ihbench.diffusion.crops.random_mask import SHARES, random_mask
from ihbench.diffusion.inpaint_config import InpaintConfig
from ihbench.diffusion.memory import ADVICE, halved
from ihbench.diffusion.subject_token import ANYBODY, SubjectToken
from ihbench.errors import BadInput

TI_SHARES = (0.25, 0.05, 0.05, 0.05, 0.10, 0.50)  # kinds of masks: mostly everything: the word must say it
SEEN_KEPT = 0.5  # share of the crops of the adaptation that are given what other frames show of what they paint
BACKGROUND_WEIGHT = 0.15  # of blocks without the person
GOOD_EVERY = 20  # steps between two copies to roll back to
TEXT_LR = 1e-5  # of LoRA on the text encoder
LEAST_FRAMES = 4
TI_STATE, ADAPT_STATE = "stage2-ti", "stage2-adapt"
ATTENTION = ["to_q", "to_k", "to_v", "to_out.0"]
TEXT_ATTENTION = ["q_proj", "k_proj", "v_proj", "out_proj"]

Good = tuple[int, dict[str, Tensor]]  # steps taken, parameters by name


@dataclass
class Curve:
    """Loss by step, for the record."""

    steps: list[int]
    losses: list[float]


class Personaliser:
    """Personalises a backbone in place. Resumes from the ledger's states; deterministic by seed."""

    def __init__(
        self, backbone: Backbone, views: list[CropView], config: InpaintConfig, seed: int, ledger: Ledger
    ) -> None:
        shown = [view for view in views if view.person.any()]
        if not shown:
            raise BadInput("personalisation: no frame shows a visible pixel of the person; nothing to learn from")
        self.backbone, self.views, self.config, self.seed, self.ledger = backbone, shown, config, seed, ledger
        self.settled = config.settled()
        self.dtype = backbone.dtype
        self.token: SubjectToken | None = None
        self.curves: dict[str, Curve] = {}

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
                added = _trainable(backbone.unet, "unet")
            named |= added
            rates |= {name: self.settled.lora_lr for name in added}
        if config.sg:
            backbone.controlnet.requires_grad_(True)
            added = _trainable(backbone.controlnet, "controlnet")
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
        return _trainable(module, prefix)

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
        """AdamW on `named`. A non-finite loss stops the stage at the last good state, and the record says so."""
        groups = [
            {"params": [named[n] for n in named if rates[n] == rate], "lr": rate, "base": rate, "weight_decay": 0.0}
            for rate in sorted(set(rates.values()))
        ]
        optimizer = torch.optim.AdamW(groups, fused=True)
        for p in named.values():
            p.data = p.data.float()  # steps of 1e-5 are lost in half precision
        curve = self.curves.setdefault(state, Curve([], []))
        step, batch = self._restored(state, named, optimizer, curve), self.config.batch
        good: Good = (step, _copies(named))
        with progress.task(what, steps) as task:
            task.advance(step)
            while step < steps:
                for group in optimizer.param_groups:
                    group["lr"] = group["base"] * (0.1 + 0.9 * 0.5 * (1 + math.cos(math.pi * step / steps)))
                optimizer.zero_grad(set_to_none=True)
                rng = np.random.default_rng((self.seed, *state.encode(), step))
                try:
                    loss = self.loss(views, rng, batch, shares, use_parts)
                    value = float("nan") if loss is None else loss.item()
                    if loss is not None and loss.requires_grad:
                        loss.backward()
                    norm = float(torch.nn.utils.clip_grad_norm_(list(named.values()), 1.0))
                    fine = loss is None or (math.isfinite(value) and math.isfinite(norm))
                    if loss is not None and fine:
                        if step % GOOD_EVERY == 0:
                            good = (step, _copies(named))  # a finite loss vouches for them
                        optimizer.step()
                except (MemoryError, RuntimeError) as error:
                    line = f"{what}: one crop does not fit into memory; {ADVICE[self.backbone.name]}"
                    batch = halved(batch, error, line)
                    self.ledger.event(Warned(f"{what}: out of memory at step {step}, batch now {batch}"))
                    continue
                if not fine:
                    why = f"{what}: loss {value}, gradient {norm} at step {step}"
                    self._roll_back(named, good, curve, why, state)
                    break
                if loss is not None:
                    curve.steps.append(step)
                    curve.losses.append(value)
                step += 1
                task.advance()
                due = self.ledger.due_to_save() and step < steps
                if (due or step == steps) and not _finite(named):  # no loss has seen this last step's outcome yet
                    self._roll_back(named, good, curve, f"{what}: parameters not finite after step {step - 1}", state)
                    break
                if due:
                    self._save(state, step, named, optimizer, curve)
        self._save(state, steps, named, optimizer, curve)
        for p in named.values():
            p.data = p.data.to(self.dtype)

    def loss(
        self, views: list[CropView], rng: np.random.Generator, batch: int, shares: tuple[float, ...], use_parts: bool
    ) -> Tensor | None:
        """Denoising loss over visible pixels hidden on purpose; None when the draw hid none of them."""
        backbone = self.backbone
        chosen = _draw(views, rng, batch)
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

    def _roll_back(self, named: dict[str, nn.Parameter], good: Good, curve: Curve, why: str, state: str) -> None:
        step, values = good
        kept = sum(n < step for n in curve.steps)
        del curve.steps[kept:], curve.losses[kept:]
        with torch.no_grad():
            for name, p in named.items():
                p.copy_(values[name])
        self.ledger.event(RolledBack(state, step, f"{why}; went back to step {step} and stopped there"))

    # --- resume ---

    def _save(
        self, state: str, step: int, named: dict[str, nn.Parameter], optimizer: torch.optim.Optimizer, curve: Curve
    ) -> None:
        tensors: dict[str, Tensor] = {f"p.{name}": p.detach() for name, p in named.items()}
        if step < (self.config.ti_steps if state == TI_STATE else self.config.lora_steps):
            for name, p in named.items():
                tensors |= {f"adam.{name}.{key}": value for key, value in optimizer.state[p].items()}
        self.ledger.save_state(state, tensors, {"step": step, "steps": curve.steps, "losses": curve.losses})

    def _restored(
        self, state: str, named: dict[str, nn.Parameter], optimizer: torch.optim.Optimizer, curve: Curve
    ) -> int:
        saved = self.ledger.load_state(state)
        if saved is None:
            return 0
        tensors, meta = saved
        with torch.no_grad():
            for name, p in named.items():
                p.copy_(torch.as_tensor(tensors[f"p.{name}"]))
                if f"adam.{name}.step" in tensors:
                    keys = ("step", "exp_avg", "exp_avg_sq")
                    kept = {key: torch.as_tensor(tensors[f"adam.{name}.{key}"]).clone() for key in keys}
                    optimizer.state[p] = {k: v if k == "step" else v.to(p.device) for k, v in kept.items()}
        curve.steps[:], curve.losses[:] = list(meta["steps"]), list(meta["losses"])
        self.ledger.event(Resumed(state, int(meta["step"])))
        return int(meta["step"])


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


def _draw(views: list[CropView], rng: np.random.Generator, batch: int) -> list[CropView]:
    """A batch of one crop width, in proportion to how many views have it."""
    groups = by_width(views)
    widths = list(groups)
    counts = np.array([len(groups[w]) for w in widths], np.float64)
    numbers = groups[widths[int(rng.choice(len(widths), p=counts / counts.sum()))]]
    return [views[k] for k in rng.choice(numbers, batch, replace=len(numbers) < batch)]


def _trainable(module: nn.Module, prefix: str) -> dict[str, nn.Parameter]:
    return {f"{prefix}.{name}": p for name, p in module.named_parameters() if p.requires_grad}


def _copies(named: dict[str, nn.Parameter]) -> dict[str, Tensor]:
    return {name: p.detach().clone() for name, p in named.items()}


def _finite(named: dict[str, nn.Parameter]) -> bool:
    return all(bool(torch.isfinite(p).all()) for p in named.values())
