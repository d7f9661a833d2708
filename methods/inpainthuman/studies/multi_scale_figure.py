"""`ihbench figures multi-scale`: the UV feature maps by level, what they decode to, and the surface's regions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from ihbench.body.canonical import canonical_pose
from ihbench.body.pose import BodyPose
from ihbench.body.uv import Texels, texel_table
from ihbench.document.picture_sheet import Panel, PictureSheet
from ihbench.errors import BadInput
from ihbench.methods.inpainthuman.avatar.avatar import GaussianAvatar
from ihbench.record.finished_run import FinishedRun
from ihbench.record.results import read_result
from ihbench.record.row_labels import by_label
from ihbench.scene.sightings import FINE

SIDE = 2 * FINE  # px of a drawn map
PAPER, SEEN = (255, 255, 255), (214, 214, 214)
HIDDEN, NEVER_SEEN = (214, 0, 160), (0, 150, 190)  # pink and blue-green differ for the colour-blind, too
SPREAD = 2.5  # standard deviations of a component that are drawn


def multi_scale(runs: Sequence[FinishedRun], views: int) -> PictureSheet:
    """A row for each run: where its surface is seen, hidden and never seen; each level's map; the decoded colour.

    A map's channels are drawn by their first three principal components over the texels of the body, each level for
    itself, so that colours of two levels or runs do not compare. Lines in the decoded colour enclose hidden (pink)
    and never-seen (blue-green) surface. `views` is not used.

    Raises `BadInput` for runs of other methods, or unfinished ones.
    """
    results = [read_result(run.folder) for run in runs]
    for result in results:
        if result.method != "inpainthuman" or result.status != "done":
            raise BadInput(
                f"{result.folder}: is a run of {result.method}, {result.status}; expected inpainthuman, done"
            )
    labels = {run.folder: label for label, row in by_label(results).items() for run in row}
    fitted = [GaussianAvatar.load(run.folder / "avatar", run.body) for run in runs]
    levels = sorted({level for avatar in fitted for level in avatar.config.levels})
    rows: list[tuple[str, list[Panel | None]]] = []
    for run, result, avatar in zip(runs, results, fitted, strict=True):
        seen = run.scene.training.sightings[FINE]
        region = regions_map(seen.texels, seen.visibility.hidden, seen.visibility.never_seen)
        maps = feature_maps(avatar)
        panels: list[Panel | None] = [Panel(region, _shares(seen.visibility.hidden, seen.visibility.never_seen))]
        panels += [Panel(maps[level]) if level in maps else None for level in levels]
        panels.append(Panel(outlined(colour_map(avatar), region)))
        rows.append((f"{result.scene}, seed {result.seed}: {labels[run.folder]}", panels))
    first = results[0]
    caption = (
        f"UV maps of {', '.join(dict.fromkeys(r.scene for r in results))} under {first.identity.protocol}, "
        f"{first.identity.profile} profile, seeds {', '.join(map(str, sorted({r.seed for r in results})))}: surface "
        "that training views show (grey), that only the occluder hides (pink), that never faces the camera "
        "(blue-green); the feature maps by level, first three principal components; the decoded colour in the "
        "canonical pose."
    )
    return PictureSheet(("surface", *(f"{level} x {level}" for level in levels), "decoded colour"), rows, caption)


def feature_maps(avatar: GaussianAvatar) -> dict[int, NDArray[np.uint8]]:
    """Level -> its map [SIDE, SIDE, 3] by principal components."""
    maps: dict[int, NDArray[np.uint8]] = {}
    table = avatar.features.table.detach().cpu().double()
    start = 0
    for level in avatar.config.levels:
        rows = table[start : start + level**2]
        start += level**2
        texels = texel_table(avatar.body, level)
        maps[level] = _drawn(texels, principal_colours(rows[torch.tensor(texels.index)]).numpy())
    return maps


def principal_colours(features: torch.Tensor) -> torch.Tensor:  # [n, C]
    """[n, 3] in [0, 1]: the first three principal components, signs settled, SPREAD deviations either way."""
    centred = features - features.mean(0)
    _, _, axes = torch.linalg.svd(centred.T @ centred / max(len(features), 1))
    axes = axes[:3]
    largest = axes.gather(1, axes.abs().argmax(1, keepdim=True))
    parts = centred @ (axes * torch.where(largest < 0, -1.0, 1.0)).T
    if parts.shape[1] < 3:
        parts = torch.nn.functional.pad(parts, (0, 3 - parts.shape[1]))
    spread = parts.std(0, unbiased=False).clamp_min(1e-12)
    return (0.5 + parts / (2 * SPREAD * spread)).clamp(0, 1)


def colour_map(avatar: GaussianAvatar) -> NDArray[np.uint8]:
    """[SIDE, SIDE, 3] the decoded colours at the avatar's texels, in the canonical pose."""
    pose = BodyPose(canonical_pose(avatar.config.canonical_pose), avatar.betas, np.zeros(3))
    return _drawn(avatar.texels, avatar.gaussians(pose)[2].clamp(0, 1).cpu().double().numpy())


def regions_map(texels: Texels, hidden: NDArray[np.bool_], never_seen: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """[SIDE, SIDE, 3] with one colour for each region."""
    colours = np.full((len(texels.index), 3), SEEN, np.float64)
    colours[hidden], colours[never_seen] = HIDDEN, NEVER_SEEN
    return _drawn(texels, colours / 255)


def outlined(picture: NDArray[np.uint8], region: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The picture with lines along the inner edge of hidden and never-seen surface."""
    from scipy.ndimage import binary_erosion

    out = picture.copy()
    for colour in (HIDDEN, NEVER_SEEN):
        inside = (region == np.array(colour, np.uint8)).all(-1)
        out[inside & np.logical_not(binary_erosion(inside, iterations=2))] = colour
    return out


def _drawn(texels: Texels, colours: NDArray[np.float64]) -> NDArray[np.uint8]:  # [N, 3] in [0, 1]
    """The map on paper, each texel a square: the same part of the body lies at the same place on every level."""
    side = texels.resolution
    flat = np.full((side * side, 3), PAPER, np.uint8)
    flat[texels.index] = np.rint(colours * 255)
    take = (np.arange(SIDE) + 0.5) * side / SIDE
    rows = take.astype(int)
    return flat.reshape(side, side, 3)[rows[:, None], rows[None]]


def _shares(hidden: NDArray[np.bool_], never_seen: NDArray[np.bool_]) -> str:
    return f"hidden {hidden.mean():.0%}, never seen {never_seen.mean():.0%}"
