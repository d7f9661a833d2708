"""The batches that `mini` learns from: what a step is fed is a function of (seed, step) alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from ihbench.diffusion.backbone import padded_ids
from ihbench.diffusion.crops.crop_dataset import Page
from ihbench.diffusion.crops.head_crop import A_PERSON_CROP
from ihbench.diffusion.crops.random_mask import random_mask
from ihbench.diffusion.crops.seen_surface import SurfaceColours
from ihbench.diffusion.mini.model import SIZE
from ihbench.diffusion.mini.training import MiniTraining

PERSON = "a photo of a person"
TRAIT_TOKENS = 4
USUAL_WIDTH = 0.75  # of a crop, as a share of its height
STRIPS = (0.7, 0.15, 0.15, 0.0, 0.0, 0.0)  # kinds of occluders of the other photographs
NOISY = 0.6  # share of the schedule, above which a dropped context is noised
LEFT = 0.15  # of the crop's sides, that a dropped context leaves at most
NOT_IN_HIDDEN = 0.35  # share of the crops whose hidden surface no other photograph shows
WHOLE_HEAD = 0.5  # share of the head crops in which everything is hidden
HEAD_SHARES = (0.25, 0.25, 0.15, 0.25, 0.10, 0.0)  # kinds of occluders of the others
BLUR = (0.035, 0.2)  # of a head crop's height, sigma of what a painting begins with
TINT = 0.04  # standard deviation of its colours' shift


class Crops:
    """All crops of a dataset, by width."""

    def __init__(self, pages: list[Page]):
        starts = np.cumsum([0, *(len(page.phrases) for page in pages)])
        self.pages = pages
        self.phrases = [phrases for page in pages for phrases in page.phrases]
        self.traits = np.concatenate([page.traits for page in pages])
        rows = []
        for k, page in enumerate(pages):
            there = np.flatnonzero(page.head_there)
            rows.append(np.column_stack([np.full(len(there), k), there, starts[k] + page.person[there]]))
        self.heads = np.concatenate(rows)  # [n, 3] page, crop, person of every head crop
        self.of_person = [[np.flatnonzero(page.person == k) for k in range(len(page.phrases))] for page in pages]
        self.by_width: dict[int, NDArray[np.int64]] = {}  # [n, 3] page, crop, person
        for width in np.unique(np.concatenate([page.widths for page in pages])):
            rows = []
            for k, page in enumerate(pages):
                crops = np.flatnonzero(page.widths == width)
                rows.append(np.column_stack([np.full(len(crops), k), crops, starts[k] + page.person[crops]]))
            self.by_width[int(width)] = np.concatenate(rows)
        self.widths = sorted(self.by_width)
        counts = np.array([len(self.by_width[w]) for w in self.widths], np.float64)
        self.shares = counts / counts.sum()

    def draw(self, rng: np.random.Generator, batch: int) -> tuple[int, NDArray[np.int64]]:
        """A width, and as many crops of it as have the pixels of `batch` crops of the usual width."""
        width = self.widths[int(rng.choice(len(self.widths), p=self.shares))]
        rows = self.by_width[width]
        size = max(round(batch * USUAL_WIDTH * SIZE / width), 1)
        return width, rows[rng.choice(len(rows), size, replace=len(rows) < size)]

    def draw_heads(self, rng: np.random.Generator, batch: int) -> NDArray[np.int64]:
        """[n, 3] as many head crops as have the pixels of `batch` crops of the usual width."""
        size = max(A_PERSON_CROP * batch, 1)
        return self.heads[rng.choice(len(self.heads), size, replace=len(self.heads) < size)]

    def head_images(self, rows: NDArray[np.int64]) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Images [B, h, w, 3], silhouettes [B, h, w], part labels [B, h, w] and guides [B, h, w, 3] of heads."""
        picked = [(self.pages[page], crop) for page, crop, _ in rows]
        return (
            np.stack([page.head_images[crop] for page, crop in picked]),
            np.stack([page.head_silhouettes[crop] for page, crop in picked]),
            np.stack([page.head_parts[crop] for page, crop in picked]),
            np.stack([page.head_guides[crop] for page, crop in picked]),
        )

    def images(self, width: int, rows: NDArray[np.int64]) -> tuple[NDArray, NDArray, NDArray]:
        """Images [B, S, W, 3], silhouettes [B, S, W] and part labels [B, S, W]."""
        picked = [(self.pages[page], crop) for page, crop, _ in rows]
        return (
            np.stack([page.images[crop, :, :width] for page, crop in picked]),
            np.stack([page.silhouettes[crop, :, :width] for page, crop in picked]),
            np.stack([page.parts[crop, :, :width] for page, crop in picked]),
        )


@dataclass(frozen=True)
class MiniBatch:
    """One step's crops, occluders, words, and the seed of its noise, which is drawn where it is used."""

    images: Tensor  # [B, S, W, 3] uint8
    seen: Tensor  # [B, S, W, 4] uint8 RGB of surface that other photographs show, and 255 there
    person: Tensor  # [B, S, W] bool
    hidden: Tensor  # [B, S, W] bool
    labels: Tensor  # [B, S, W] uint8
    timesteps: Tensor  # [B]
    traits: Tensor  # [B, T]
    people: Tensor  # [B]
    told: Tensor  # [B] bool: the person's word vectors stand in the place of words
    ids: Tensor  # [B, L] the prompts
    noise_seed: int
    use_parts: bool
    fills: Tensor | None = None  # [B, S, W, 3] uint8 what painting heads begins with
    guides: Tensor | None = None  # [B, S, W, 3] uint8 what guides it in the place of the part map

    def to(self, device: torch.device) -> MiniBatch:
        return self._each(lambda tensor: tensor.to(device, non_blocking=True))

    def pin_memory(self) -> MiniBatch:
        """Called by torch's loader: a GPU copies pinned memory while it computes."""
        return self._each(Tensor.pin_memory)

    def _each(self, change: Callable[[Tensor], Tensor]) -> MiniBatch:
        tensors = {name: value for name, value in vars(self).items() if isinstance(value, Tensor)}
        return replace(self, **{name: change(tensor) for name, tensor in tensors.items()})


class Batches(Dataset[MiniBatch]):
    """`batches[step]`."""

    def __init__(self, config: MiniTraining, crops: Crops, timesteps: int, tokenizer: Any, max_tokens: int):
        self.config, self.crops, self.timesteps = config, crops, timesteps
        self.tokenizer, self.max_tokens = tokenizer, max_tokens

    def __getitem__(self, step: int) -> MiniBatch:
        rng = np.random.default_rng((self.config.seed, step))
        return self.heads(rng) if rng.random() < self.config.heads else self.persons(rng)

    def persons(self, rng: np.random.Generator) -> MiniBatch:
        """A step's crops of whole persons."""
        config = self.config
        width, rows = self.crops.draw(rng, config.batch)
        images, person, labels = self.crops.images(width, rows)
        dropped = rng.random(len(rows)) < config.context_dropped
        hidden = np.stack([(nearly_all if d else random_mask)(rng, s) for s, d in zip(person, dropped, strict=True)])
        seen = np.stack([self.seen(rng, row, width, h) for row, h in zip(rows, hidden, strict=True)])
        seen[dropped] = 0  # or it would say who it is
        use_parts = bool(rng.random() < config.control)
        prompts, captioned = self.words(rng, rows[:, 2])
        # less noise would say who it is: of a dropped context the words alone are to
        lowest = np.where(dropped, round(NOISY * self.timesteps), 0)
        return MiniBatch(
            *(torch.from_numpy(array) for array in (images, seen, person, hidden, labels)),
            timesteps=torch.from_numpy(rng.integers(lowest, self.timesteps)),
            traits=torch.from_numpy(self.crops.traits[rows[:, 2]]),
            people=torch.from_numpy(rows[:, 2]),
            told=torch.tensor(captioned),
            ids=padded_ids(self.tokenizer, prompts, self.max_tokens),
            noise_seed=int(rng.integers(2**62)),
            use_parts=use_parts,
        )

    def heads(self, rng: np.random.Generator) -> MiniBatch:
        """A step's crops of heads: all of each hidden or part of it, painting begins with a blurred one."""
        rows = self.crops.draw_heads(rng, self.config.batch)
        images, person, labels, guides = self.crops.head_images(rows)
        hidden = np.stack([hidden_head(rng, mask) for mask in person])
        fills = np.stack([begun_head(rng, image, mask) for image, mask in zip(images, person, strict=True)])
        prompts, captioned = self.words(rng, rows[:, 2])
        seen = np.zeros((*labels.shape, 4), np.uint8)
        return MiniBatch(
            *(torch.from_numpy(array) for array in (images, seen, person, hidden, labels)),
            timesteps=torch.from_numpy(rng.integers(0, self.timesteps, len(rows))),
            traits=torch.from_numpy(self.crops.traits[rows[:, 2]]),
            people=torch.from_numpy(rows[:, 2]),
            told=torch.tensor(captioned),
            ids=padded_ids(self.tokenizer, prompts, self.max_tokens),
            noise_seed=int(rng.integers(2**62)),
            use_parts=True,
            fills=torch.from_numpy(fills),
            guides=torch.from_numpy(guides),
        )

    def seen(
        self, rng: np.random.Generator, row: NDArray[np.int64], width: int, hidden: NDArray[np.bool_]
    ) -> NDArray[np.uint8]:
        """[S, W, 4] a crop's surface as some of the person's other photographs show it, from behind occluders of
        their own; nothing in a share of the crops, and in a further share nothing of what is hidden."""
        page, crop = self.crops.pages[row[0]], row[1]
        cells = page.cells[crop, :, :width]
        if rng.random() >= self.config.seen:
            return np.zeros((*cells.shape, 4), np.uint8)
        others = self.crops.of_person[row[0]][page.person[crop]]
        others = rng.permutation(others[others != crop])
        known = SurfaceColours()
        for other in others[: rng.integers(1, len(others) + 1)] if len(others) else ():
            person = page.silhouettes[other]
            known.show(page.cells[other], page.images[other], person & ~random_mask(rng, person, STRIPS))
        out = known.drawn(cells)[0]
        if rng.random() < NOT_IN_HIDDEN:
            out[hidden] = 0
        return out

    def words(self, rng: np.random.Generator, people: NDArray[np.int64]) -> tuple[list[str], list[bool]]:
        """A prompt for each, and whether trait tokens speak in it."""
        config = self.config
        prompts, captioned = [], []
        for person in people:
            chance = rng.random()
            captioned.append(bool(chance < config.traits))
            kept = [phrase for phrase in self.crops.phrases[person] if rng.random() < config.phrase_kept]
            if chance < config.traits:
                prompts.append(" ".join(["a photo of", *["person"] * TRAIT_TOKENS]))
            elif chance < config.traits + config.captions and kept:
                order = rng.permutation(len(kept))
                prompts.append(f"{PERSON} with {' , '.join(kept[k] for k in order)}")
            else:
                prompts.append(PERSON)
        return prompts, captioned

    def stream(self, first: int, last: int, workers: int, pinned: bool = False) -> Iterator[MiniBatch]:
        """Batches of steps `first` to `last` - 1, made by workers ahead of their time; `pinned` for a GPU."""
        return iter(
            DataLoader(
                self,
                batch_size=None,
                sampler=range(first, last),
                num_workers=workers,
                pin_memory=pinned,
                prefetch_factor=4 if workers else None,
            )
        )


def hidden_head(rng: np.random.Generator, person: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """[H, W] an occluder before a head crop: mostly all of it."""
    if rng.random() < WHOLE_HEAD:
        return np.ones(person.shape, bool)
    return random_mask(rng, person, HEAD_SHARES)


def begun_head(
    rng: np.random.Generator, image: NDArray[np.uint8], person: NDArray[np.bool_], sigma: float | None = None
) -> NDArray[np.uint8]:
    """[H, W, 3] a head as the painter of whole persons leaves it: soft, and not quite in its colours. `sigma` px is
    drawn where none is given."""
    given, tint = sigma is not None, rng.normal(0, 255 * TINT, 3)
    low, high = np.log(BLUR)
    sigma = float(np.exp(rng.uniform(low, high)) * len(image)) if sigma is None else sigma
    inside = person.astype(np.float32)
    weight = gaussian_filter(inside, sigma)
    soft = gaussian_filter(image.astype(np.float32) * inside[..., None], (sigma, sigma, 0))
    soft = soft / np.maximum(weight, 1e-3)[..., None] + (0 if given else tint)
    edge = gaussian_filter(inside, 1.0)[..., None]
    return np.clip(np.rint(edge * soft + (1 - edge) * 255), 0, 255).astype(np.uint8)


def nearly_all(rng: np.random.Generator, person: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """[H, W] a mask that hides everything, or leaves a small window about one of the person's pixels."""
    out = np.ones(person.shape, bool)
    rows, cols = np.nonzero(person)
    if len(rows) and rng.random() < 0.5:
        k = int(rng.integers(len(rows)))
        h, w = (rng.uniform(0.03, LEFT, 2) * person.shape).astype(int)
        out[max(rows[k] - h // 2, 0) : rows[k] + h // 2 + 1, max(cols[k] - w // 2, 0) : cols[k] + w // 2 + 1] = False
    return out
