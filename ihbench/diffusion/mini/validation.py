"""How well a backbone paints procedural people that it was not trained on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from ihbench import registry
from ihbench.clock.progress import Progress
from ihbench.diffusion.backbone import Backbone
from ihbench.diffusion.crops.crop_dataset import PAGE, CropDataset, Page
from ihbench.diffusion.crops.diffusion_batch import DiffusionBatch, shared_noise
from ihbench.diffusion.crops.part_map import part_colours
from ihbench.diffusion.crops.push_pull import push_pull
from ihbench.diffusion.crops.seen_surface import SurfaceColours
from ihbench.diffusion.sampling import sample
from ihbench.diffusion.subject_token import ANYBODY

STEPS = (1, 6, 20)
NOISES = (0.0, 1.0)
GUIDES = {"without parts": "nothing", "with parts": "parts", "with parts and other photographs": "all"}
STRIP = 0.5  # share of the person that the central strip hides
PEOPLE = 48


@dataclass(frozen=True)
class Validation:
    people: int
    strip: float
    hidden_psnr: dict[str, float]  # by what paints, dB


def validate(backbone: Backbone, dataset: Path, each: int, progress: Progress) -> Validation:
    """Hidden-body PSNR, pooled, on held-out people with a central strip; nothing is personalised."""
    people, device = registry.load("people", "procedural"), backbone.device
    store = CropDataset(dataset, "procedural", each, backbone.size)
    store.make(people.HELD_OUT, PAGE, progress)
    page = next(iter(store.pages(people.HELD_OUT, PAGE)))
    errors: dict[str, list[NDArray[np.float64]]] = {}
    first = np.array([np.flatnonzero(page.person == k)[0] for k in range(PEOPLE)])
    with progress.task("validating", PEOPLE) as task:
        for width in np.unique(page.widths[first]):
            rows = first[page.widths[first] == width]
            images, person = page.images[rows, :, :width], page.silhouettes[rows, :, :width]
            hidden = np.stack([central_strip(mask) for mask in person])
            colours = part_colours(page.parts[rows, :, :width])
            seen = np.stack([_seen_by_others(page, row, int(width)) for row in rows])
            batch = DiffusionBatch(
                pixels=torch.from_numpy(images).to(device).movedim(-1, 1).float() / 127.5 - 1,
                unknown=torch.from_numpy(hidden).to(device)[:, None].float(),
                person=torch.from_numpy(person & ~hidden).to(device)[:, None].float(),
                parts=torch.from_numpy(colours).to(device).movedim(-1, 1).float() / 255,
                seen=torch.from_numpy(seen).to(device).movedim(-1, 1).float() / 255,
            )
            alone = replace(batch, seen=torch.zeros_like(batch.seen))
            field = shared_noise(backbone, 0, int(width))
            made = {
                "mean visible colour, silhouette given": _mean_colour(batch),
                "push-pull, silhouette given": push_pull(batch.pixels, batch.person),
            }
            for steps, noise, (guide, given) in product(STEPS, NOISES, GUIDES.items()):
                name = f"mini, {steps} steps, noise {noise:g}, {guide}"
                shown = batch if given == "all" else alone
                made[name] = sample(
                    backbone, shown, noise * field, ANYBODY, steps=steps, use_parts=given != "nothing"
                )
            where = torch.from_numpy(hidden & person).to(device)
            for name, painted in made.items():
                error = ((painted - batch.pixels) / 2).square().mean(1)[where]
                errors.setdefault(name, []).append(error.double().cpu().numpy())
            task.advance(len(rows))
    psnr = {name: float(-10 * np.log10(np.concatenate(parts).mean())) for name, parts in errors.items()}
    return Validation(PEOPLE, STRIP, psnr)


def _seen_by_others(page: Page, crop: int, width: int) -> NDArray[np.uint8]:
    """[S, W, 4] a crop's surface as the person's other photographs show it, each behind its own central strip."""
    known = SurfaceColours()
    for other in np.flatnonzero(page.person == page.person[crop]):
        if other != crop:
            person = page.silhouettes[other]
            known.show(page.cells[other], page.images[other], person & ~central_strip(person))
    return known.drawn(page.cells[crop, :, :width])[0]


def central_strip(person: NDArray[np.bool_], share: float = STRIP) -> NDArray[np.bool_]:
    """[H, W] the narrowest full-height strip about the person's mean column that hides at least a share of them."""
    columns = person.sum(0)
    middle = round(float((columns * np.arange(len(columns))).sum() / max(columns.sum(), 1)))
    out = np.zeros(person.shape, bool)
    for half in range(1, len(columns) + 1):
        out[:, max(middle - half, 0) : middle + half] = True
        if (person & out).sum() >= share * person.sum():
            break
    return out


def _mean_colour(batch: DiffusionBatch) -> torch.Tensor:
    total = (batch.pixels * batch.person).sum((2, 3), keepdim=True)
    return (total / batch.person.sum((2, 3), keepdim=True).clamp(min=1)).expand_as(batch.pixels)
