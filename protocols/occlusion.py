"""Occlusion rules: which pixels of the original training images an occluder hides.

A rule is a pure function of an `OcclusionRequest`. It hides whole pixels of the original, distorted image, before
undistortion, as the released readers do. Rules that draw something draw the same for a seed, subject and frame.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ihbench.errors import BadInput
from ihbench.scene.occlusion import Mask, Occlusion, OcclusionRequest, grown_for_clothes, occluder

BLOCKS_ACROSS = 12  # random blocks along the longer side of the person


@occluder(takes_fraction=False)
def none(request: OcclusionRequest) -> Occlusion:
    """Hides nothing."""
    nothing: Mask = np.broadcast_to(np.False_, (request.height, request.width))
    return Occlusion("none", lambda frame: nothing, {}, hides_nothing=True)


# ----------------------------------------------------------------------------------------------------
# The same columns in every covered frame


@occluder(takes_fraction=False)
def fixed_strip(request: OcclusionRequest) -> Occlusion:
    """All rows of columns [mid - width//2, mid + width//2), the same in every covered frame.

    The columns are published per subject for 1024-px images (tiangexiang/OccFusion scene/dataset_readers.py:562-569,
    tiangexiang/OccNeRF configs) and scale with the image width. Raises `BadInput` for a subject without a strip.
    """
    rule = request.rule
    strips = rule.strips or {}
    if request.subject not in strips:
        raise BadInput(
            f"occlusion 'fixed-strip': no strip is published for subject {request.subject!r}; "
            f"use --occlusion.rule strip-generic"
        )
    mid, width = strips[request.subject]
    scale = request.width / rule.reference_width
    return _strip("fixed-strip", round(mid * scale), round(width * scale), request)


def strip_generic(request: OcclusionRequest) -> Occlusion:
    """The same kind of strip for any data: centred on the mean person column over the covered frames, as wide as it
    must be (smallest even width) to hide at least `fraction` of the pooled person pixels.

    Reproduces what the comments in OccNeRF's subject files say their strips were tuned for. Raises `BadInput` when no
    covered frame shows anybody.
    """
    columns = np.zeros(request.width, np.int64)
    for frame in request.covered_frames:
        columns += request.silhouette(frame).sum(0)
    if columns.sum() == 0:
        raise BadInput(f"occlusion 'strip-generic': no person pixel in any covered frame of {request.subject!r}")
    mid, width = _narrowest_band(columns, request.rule.fraction)
    return _strip("strip-generic", mid, width, request)


def _narrowest_band(
    counts: NDArray[np.integer],  # [n] person pixels of each column
    fraction: float,
) -> tuple[int, int]:
    """(mid, even width), px, of the narrowest band around the mean column that holds this share of the counts."""
    total, n = int(counts.sum()), len(counts)
    mid = round(float((np.arange(n) * counts).sum() / total))
    below = np.concatenate([[0], np.cumsum(counts)])
    half = np.arange(n + 1)
    held = below[np.minimum(mid + half, n)] - below[np.maximum(mid - half, 0)]
    return mid, 2 * int(np.flatnonzero(held >= fraction * total)[0])


def _columns(mid: int, width: int, request: OcclusionRequest) -> Mask:
    """[W] True in [mid - width//2, mid + width//2)."""
    return np.abs(np.arange(request.width) + 0.5 - mid) < width // 2


def _strip(rule: str, mid: int, width: int, request: OcclusionRequest) -> Occlusion:
    hidden = np.broadcast_to(_columns(mid, width, request), (request.height, request.width))
    return Occlusion(rule, lambda frame: hidden, {"mid": mid, "width": width})


# ----------------------------------------------------------------------------------------------------
# Anew in every frame


def central_band(request: OcclusionRequest) -> Occlusion:
    """A full-height band that follows the person: centred on their mean column in every frame, as wide as it must be
    (smallest even width) to hide at least `fraction` of the frame's person pixels."""

    def hidden(frame: int, person: Mask) -> Mask:  # [H, W] both, original image
        mid, width = _narrowest_band(person.sum(0), request.rule.fraction)
        return np.broadcast_to(_columns(mid, width, request), person.shape)

    return _per_frame("central-band", request, hidden)


def side(request: OcclusionRequest) -> Occlusion:
    """Everything left of a column, in every frame the one that hides at least `fraction` of the person."""
    return _up_to("side", request, 0)


def upper_half(request: OcclusionRequest) -> Occlusion:
    """Everything above a row, in every frame the one that hides at least `fraction` of the person (a half by
    default)."""
    return _up_to("upper-half", request, 1)


def lower_half(request: OcclusionRequest) -> Occlusion:
    """Everything below a row, as a table before the person; in every frame at least `fraction` of them."""
    return _up_to("lower-half", request, 1, step=-1)


def _up_to(rule: str, request: OcclusionRequest, axis: int, step: int = 1) -> Occlusion:
    """The first columns (axis 0) or rows (1), with step -1 the last ones."""

    def hidden(frame: int, person: Mask) -> Mask:  # [H, W] both, original image
        counts = person.sum(axis)[::step]
        line = np.arange(len(counts)) < _first_share(counts, request.rule.fraction)
        return np.broadcast_to(np.expand_dims(line[::step], axis), person.shape)

    return _per_frame(rule, request, hidden)


def blocks(request: OcclusionRequest) -> Occlusion:
    """Random square blocks, a twelfth of the person's longer side each, until at least `fraction` of the frame's
    person is hidden. The last block is cut to what is still wanted."""

    def hidden(frame: int, person: Mask) -> Mask:  # [H, W] both, original image
        rows, columns = np.nonzero(person)
        block = max(1, max(np.ptp(rows), np.ptp(columns)) // BLOCKS_ACROSS)
        cell = (np.arange(request.height) // block)[:, None] * request.width + np.arange(request.width) // block
        rng = _rng(request, frame)
        order = rng.permutation(np.unique(cell[person]))
        counts = np.bincount(cell[person])[order]
        pixels = request.rule.fraction * person.sum()
        whole = int(np.searchsorted(np.cumsum(counts), pixels, side="right"))
        out = np.isin(cell, order[:whole])
        missing = int(np.ceil(pixels - counts[:whole].sum()))
        if missing > 0:
            last = cell == order[whole]
            stop = _first_share((last & person).sum(1), missing / counts[whole])
            out |= last & (np.arange(request.height) < stop)[:, None]
        return out

    return _per_frame("blocks", request, hidden)


def pasted_object(request: OcclusionRequest) -> Occlusion:
    """The silhouette of a made-up object (a smooth star-shaped blob, drawn anew for every subject) before the person,
    at a seeded place that drifts slowly with the frames, as large as it must be to hide `fraction` of the person."""
    seed = _rng(request, None)
    waves = np.arange(2, 7)
    shape = seed.normal(0, 0.5, (2, len(waves))) / waves
    stretch = np.exp(seed.normal(0, 0.25))
    start, drift = seed.uniform(0, 2 * np.pi), seed.uniform(0.5, 1.5)
    last = max(request.covered_frames, default=0) + 1

    def hidden(frame: int, person: Mask) -> Mask:  # [H, W] both, original image
        rows, columns = np.nonzero(person)
        turn = start + drift * 2 * np.pi * frame / last
        x = columns.mean() + 0.25 * np.ptp(columns) * np.cos(turn)
        y = rows.mean() + 0.25 * np.ptp(rows) * np.sin(turn)
        dy = (np.arange(request.height) + 0.5 - y)[:, None] / stretch
        dx = (np.arange(request.width) + 0.5 - x)[None] * stretch
        angle = np.arctan2(dy, dx)[..., None] * waves
        outline = 1 + (shape[0] * np.cos(angle) + shape[1] * np.sin(angle)).sum(-1).clip(-0.6, 2)
        size = np.hypot(dx, dy) / outline  # the object of this size reaches the pixel
        reach = np.sort(size[person])
        count = int(np.ceil(request.rule.fraction * len(reach)))
        return size <= reach[count - 1] if count else np.zeros(person.shape, bool)

    return _per_frame("object", request, hidden)


@occluder(in_scene=True, takes_fraction=False)
def natural(request: OcclusionRequest) -> Occlusion:
    """What stands before the person in the image itself: the projected body, a little grown for clothes, where the
    mask of visible pixels does not show it. For data whose masks are of visible pixels (OcMotion)."""

    def hidden(frame: int) -> Mask:  # also of a person of whom nothing shows
        return grown_for_clothes(request.body_mask(frame)) & ~request.silhouette(frame)

    return Occlusion("natural", hidden, {})


def _per_frame(
    rule: str,
    request: OcclusionRequest,
    hidden: Callable[[int, Mask], Mask],  # raw frame number, person [H, W] -> [H, W], original image
) -> Occlusion:
    """A rule that looks at each frame by itself; a frame without anybody hides nothing."""

    def of(frame: int) -> Mask:
        person = request.silhouette(frame)
        return hidden(frame, person) if person.any() else np.zeros(person.shape, bool)

    record: dict[str, float] = {"fraction": request.rule.fraction}
    if rule in ("blocks", "object"):
        record["seed"] = request.rule.seed or 0
    return Occlusion(rule, of, record)


def _first_share(
    counts: NDArray[np.integer],  # [n] person pixels of each column or row
    fraction: float,
) -> int:
    """How many leading entries hold at least this share of the counts."""
    held = np.concatenate([[0], np.cumsum(counts)])
    return int(np.searchsorted(held, fraction * held[-1], side="left"))


def _rng(request: OcclusionRequest, frame: int | None) -> np.random.Generator:
    name = int.from_bytes(hashlib.sha256(request.subject.encode()).digest()[:4])
    return np.random.default_rng([request.rule.seed or 0, name, *([] if frame is None else [frame])])
