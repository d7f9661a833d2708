"""Inpainting with a backbone: DDIM from shared noise, the original kept wherever it is known."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ihbench.clock.events import Resumed
from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.diffusion.backbone import Backbone
from ihbench.diffusion.crops.crop_view import CropView
from ihbench.diffusion.crops.diffusion_batch import DiffusionBatch, batch_of, by_width, shared_noise
from ihbench.diffusion.memory import ADVICE, halved
from ihbench.errors import Diverged

STATE = "stage2-sampled"


@torch.no_grad()
def sample(
    backbone: Backbone,
    batch: DiffusionBatch,
    noise: Tensor,  # [C, h, w] or [B, C, h, w]
    prompt: str,
    *,
    steps: int,
    use_parts: bool,
    guidance: float = 1.0,
    negative: str = "",
    control_scale: float = 1.0,
    guess: bool = False,
) -> Tensor:
    """[B, 3, H, W] in [-1, 1]: what the model paints, known pixels not yet put back.

    `guidance` above 1 is classifier-free guidance against the prompt `negative`. `control_scale` is of what the
    ControlNet adds; with `guess` (diffusers' guess mode) it guides the prompted half alone, less at fine levels.
    """
    scheduler = backbone.scheduler
    scheduler.set_timesteps(steps, device=backbone.device)
    fill = None if batch.fill is None else batch.fill.to(backbone.dtype)
    condition = backbone.condition(batch.pixels.to(backbone.dtype), batch.unknown, batch.person, fill)
    prompts = [prompt] if guidance <= 1 else [prompt, negative]
    text = backbone.text(prompts)
    guide = batch.guide if use_parts else None
    latents = noise.expand(len(batch), *noise.shape[-3:]).to(backbone.dtype) * scheduler.init_noise_sigma
    for t in scheduler.timesteps:
        given = scheduler.scale_model_input(latents, t)
        predicted = _predict(backbone, given, t, condition, text, guide, guidance, control_scale, guess)
        latents = scheduler.step(predicted, t, latents, return_dict=False)[0]
    return backbone.codec.decode(latents).float().clamp(-1, 1)


def _predict(
    backbone: Backbone,
    noisy: Tensor,
    t: Tensor,
    condition: Tensor,
    text: Tensor,
    guide: Tensor | None,
    guidance: float,
    control_scale: float,
    guess: bool,
) -> Tensor:
    n = len(noisy)
    times = t.expand(n)
    said = backbone.predict(
        noisy, times, condition, text[:1].expand(n, -1, -1), guide, control_scale=control_scale, guess=guess
    )
    if len(text) == 1:
        return said
    negative = text[1:].expand(n, -1, -1)
    unsaid = backbone.predict(
        noisy, times, condition, negative, None if guess else guide, control_scale=control_scale
    )
    return unsaid + guidance * (said - unsaid)


def inpaint_views(
    backbone: Backbone,
    views: list[CropView],
    prompt: str,
    progress: Progress,
    *,
    seed: int,
    steps: int,
    use_parts: bool,
    guidance: float = 1.0,
    noise_scale: float = 1.0,
    batch: int = 8,
    ledger: Ledger | None = None,
    state: str = STATE,
    negative: str = "",
    control_scale: float = 1.0,
    guess: bool = False,
) -> list[NDArray[np.uint8]]:
    """One completed crop per view. A batch that does not fit into memory is halved; when a single crop does not fit,
    `BadInput` says so. `Diverged` for a result that is not finite. With a run's ledger a killed call goes on behind
    the last batch saved, as `state`; the batches, and so the pixels, are those of a call that was not killed. What
    guides is as in `sample`."""
    out: list[NDArray[np.uint8]] = [view.image for view in views]
    done = _restored(ledger, out, state)
    todo = {k for k, view in enumerate(views) if view.unknown.any()}
    with progress.task("inpainting", len(todo)) as task:
        task.advance(len(done))
        for width, numbers in by_width(views).items():
            height = views[numbers[0]].crop.height
            noise = noise_scale * shared_noise(backbone, seed, width, height)
            rest = [k for k in numbers if k in todo]
            while rest:
                now, rest = rest[:batch], rest[batch:]
                if done.issuperset(now):
                    continue
                try:
                    painted = sample(
                        backbone, batch_of([views[k] for k in now], backbone.device), noise, prompt,
                        steps=steps, use_parts=use_parts, guidance=guidance, negative=negative,
                        control_scale=control_scale, guess=guess,
                    )  # fmt: skip
                except (MemoryError, RuntimeError) as error:
                    size = f"{width}×{height} px"
                    line = f"inpainting: one crop of {size} does not fit into memory; {ADVICE[backbone.name]}"
                    batch, rest = halved(batch, error, line), now + rest
                    continue
                if not torch.isfinite(painted).all():
                    raise Diverged(0, "the inpainted image is not finite")
                pixels = ((painted + 1) * 127.5).round().to(torch.uint8).movedim(1, -1).cpu().numpy()
                for k, image in zip(now, pixels, strict=True):
                    out[k] = views[k].completed(image)
                task.advance(len(now))
                done.update(now)
                if ledger is not None and ledger.due_to_save() and len(done) < len(todo):
                    ledger.save_state(state, {f"{k}": out[k] for k in done}, {"step": len(done)})
    return out


def _restored(ledger: Ledger | None, out: list[NDArray[np.uint8]], state: str) -> set[int]:
    """Put the crops that a killed call has saved into `out`; their numbers."""
    saved = None if ledger is None else ledger.load_state(state)
    if ledger is None or saved is None:
        return set()
    tensors, meta = saved
    for k, image in tensors.items():
        out[int(k)] = np.asarray(image)
    ledger.event(Resumed(state, meta["step"]))
    return {int(k) for k in tensors}
