"""What the diffusion model is told of a view (gtu/guidance, 358-386, 757-876; diffusion_inversion). The small
backbone knows no word for sides or quality: it is told of the person alone, and the part map says the rest."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ihbench.body.skinning_numpy import axis_angle_to_matrix
from ihbench.camera import Camera
from ihbench.diffusion.score_distillation import Prompts
from ihbench.diffusion.subject_token import ANYBODY, PHOTO_OF
from ihbench.methods.gtu.random_views import Kind

Side = Literal["front", "side", "back"]
QUALITY = "high quality, 8k uhd, realistic"
NEGATIVE = (
    "two people, low quality, lowres, bad anatomy, bad, hands, missing fingers, worst quality, nsfw"  # as released
)
OPPOSITE: dict[Side, str] = {"front": ", back view", "side": "", "back": ", front view"}
FRONT_BELOW, BACK_ABOVE = 45, 135  # degrees of azimuth
EXTENT: dict[Kind, str] = {
    "head": ", {side} side of face", "upper": ", upper body, {side} view of upper body",
    "lower": ", lower body, {side} view of lower body", "entire": ", full body", "canonical": ", full body",
}  # fmt: skip


def side_of(azimuth: float) -> Side:
    """Degrees -180..180 -> which side of the person is seen."""
    return "front" if abs(azimuth) < FRONT_BELOW else "back" if abs(azimuth) > BACK_ABOVE else "side"


def azimuth_of(camera: Camera, pose: NDArray[np.float64], root: NDArray[np.float64]) -> float:
    """Degrees -180..180 around the upright of a person with this pose [24, 3], root joint [3] m: 0 is the face."""
    there = axis_angle_to_matrix(pose[0]).T @ (camera.center - root)
    return float(np.rad2deg(np.arctan2(there[0], there[2])))


def prompts_of(backbone: str, words: Sequence[str], kind: Kind, azimuth: float) -> Prompts:
    """For a random view; `words` are the person's, none for anybody."""
    if backbone == "mini":
        return Prompts(" ".join([PHOTO_OF, *words]) if words else ANYBODY, ANYBODY, ANYBODY)
    side = side_of(azimuth)
    where = f", {side} view{EXTENT[kind].format(side=side)}"
    person = " ".join(["a", *words, "person"])
    return Prompts(
        positive=f"{PHOTO_OF} {person}, {QUALITY}{where}",
        negative=NEGATIVE + OPPOSITE[side],
        control=f"{PHOTO_OF} a person, {QUALITY}{where}",
    )


def caption(backbone: str, words: Sequence[str], scale: float, azimuth: float, rng: np.random.Generator) -> str:
    """For a training picture of the identity, in which the person is `scale` times as large as the picture allows."""
    if backbone == "mini":
        return " ".join([PHOTO_OF, *words])
    if scale < 0.6:
        size = ("a far away ", "very small ")[rng.integers(2)]
    elif scale < 0.8:
        size = ("small ", "")[rng.integers(2)]
    elif scale > 1:
        size = ("zoomed in ", "close up ")[rng.integers(2)]
    else:
        size = ""
    return f"{size}photo of {' '.join(['a', *words, 'person'])}, {side_of(azimuth)} view"
