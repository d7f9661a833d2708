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
from ihbench.diffusion.crops.diffusion_batch import DiffusionBatch, shared_noise, signed
from ihbench.diffusion.crops.head_places import head_of, marked
from ihbench.diffusion.crops.part_map import part_colours
from ihbench.diffusion.crops.push_pull import push_pull
from ihbench.diffusion.crops.seen_surface import SurfaceColours
from ihbench.diffusion.mini.batches import begun_head
from ihbench.diffusion.sampling import sample
from ihbench.diffusion.subject_token import ANYBODY

STEPS = (1, 6, 20)
NOISES = (0.0, 1.0)
GUIDES = {"without parts": "nothing", "with parts": "parts", "with parts and other photographs": "all"}
STRIP = 0.5  # share of the person that the central strip hides
PEOPLE = 48
FACE_BLUR = 0.08  # of a head crop's height


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
                pixels=signed(torch.from_numpy(images).to(device)),
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
    errors |= _hidden_faces(backbone, page, progress)
    psnr = {name: float(-10 * np.log10(np.concatenate(parts).mean())) for name, parts in errors.items()}
    return Validation(PEOPLE, STRIP, psnr)


def _hidden_faces(backbone: Backbone, page: Page, progress: Progress) -> dict[str, list[NDArray[np.float64]]]:
    """Squared errors of heads of which everything is hidden and the model begins with a blurred one: every held-out
    person's first that shows a face."""
    faces = page.head_there & (marked(page.head_guides) & head_of(page.head_parts)).any((1, 2))
    first = [np.flatnonzero(faces & (page.person == k))[:1] for k in range(PEOPLE)]
    rows = np.concatenate(first)
    if not len(rows):
        return {}
    device = backbone.device
    images, person, guides = page.head_images[rows], page.head_silhouettes[rows], page.head_guides[rows]
    height, width = images.shape[1:3]
    rng = np.random.default_rng(0)
    soft = np.stack([begun_head(rng, *each, FACE_BLUR * height) for each in zip(images, person, strict=True)])
    begun = signed(torch.from_numpy(soft).to(device))
    there = torch.from_numpy(person).to(device)[:, None].float()
    batch = DiffusionBatch(
        pixels=signed(torch.from_numpy(images).to(device)),
        unknown=torch.ones_like(there),
        person=torch.zeros_like(there),
        parts=torch.from_numpy(guides).to(device).movedim(-1, 1).float() / 255,
        seen=torch.zeros(len(rows), 4, height, width, device=device),
        fill=begun,
    )
    field = shared_noise(backbone, 0, width, height)
    made = {"hidden face, as it begins": begun}
    with progress.task("validating faces", 1):
        made["hidden face, mini, 6 steps, noise 0"] = sample(
            backbone, batch, 0 * field, ANYBODY, steps=6, use_parts=True
        )
    return {
        name: [((painted - batch.pixels) / 2).square().mean(1)[there[:, 0] > 0].double().cpu().numpy()]
        for name, painted in made.items()
    }


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
