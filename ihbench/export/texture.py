"""An avatar's colours on the body's UV map, and its relief over the body: what a mesh can show of it.

Where the avatar's Gaussians lie at texels of that map, the map is their colours and the relief their places. Any
other avatar is drawn from all around in one pose, and every texel takes the pixels that show it, those that look
straight at it most.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench.body import Body
from ihbench.body.pose import BodyPose
from ihbench.body.uv import Texels, nearest_on_chart, texel_table
from ihbench.camera import Camera
from ihbench.clock.progress import Progress
from ihbench.export.relief import fitted_relief
from ihbench.metrics.eight_bit import displayed
from ihbench.scene.visibility import PosedSurface
from ihbench.show.detail import drawn
from ihbench.show.framing import Framing
from ihbench.show.motion import stand_of, up_axis

Array = NDArray[np.float64]

SIDE = 512  # texels of a map that is baked from pictures
PICTURE = 768  # px of these
AROUND, HEIGHTS = 12, (-35.0, 5.0, 45.0)  # views: so many about the vertical, at these degrees above the horizon
POLES = (-85.0, 85.0)
STRAIGHT = 4  # power of the cosine to the surface with which a view counts
SOLID = 0.5  # alpha above which a pixel shows the avatar
BLACK = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Baked:
    texture: NDArray[np.uint8]  # [R, R, 3] sRGB, row 0 at the top, filled beyond the charts
    relief: Array | None  # [V, 3] m, on the shaped T-pose before skinning; None where only colours are known
    how: str


def baked(
    avatar: Any,
    body: Body,
    body_pose: BodyPose,  # one in which no limb hides another
    progress: Progress,
    side: int = SIDE,
    pixel: float | None = None,  # m at the body, of the training images: see `show.detail`
) -> Baked:
    """The best that this avatar allows."""
    texels = getattr(avatar, "texels", None)
    if isinstance(texels, Texels) and hasattr(avatar, "posed_gaussians"):
        gaussians = avatar.posed_gaussians(body_pose)
        if gaussians.sh_degree is None and len(gaussians.means) == len(texels.index):
            colors, means = (v.detach().cpu().double().numpy() for v in (gaussians.colors, gaussians.means))
            relief = fitted_relief(means, texels, avatar, body, body_pose, pixel)
            how = f"colours and places of the avatar's {len(means)} texels"
            return Baked(_filled(texels, colors, np.isfinite(colors).all(1)), relief, how)
    colors, seen = _from_pictures(avatar, body, body_pose, texel_table(body, side), progress, pixel)
    how = f"{AROUND * len(HEIGHTS) + len(POLES)} pictures of the avatar; {seen.mean():.0%} of the texels are in one"
    return Baked(_filled(texel_table(body, side), colors, seen), None, how)


def _from_pictures(
    avatar: Any, body: Body, body_pose: BodyPose, texels: Texels, progress: Progress, pixel: float | None
) -> tuple[Array, NDArray[np.bool_]]:
    """[N, 3] colours in [0, 1], and which texels [N] any picture shows."""
    total, weight = np.zeros((len(texels.index), 3)), np.zeros(len(texels.index))
    cameras = list(_cameras(body, body_pose))
    with progress.task("baking", len(cameras)) as task:
        for camera in cameras:
            color, alpha = drawn(avatar, camera, body_pose, BLACK, None, body, pixel, sharp=False)
            faced = PosedSurface(body, camera, body_pose).faced(texels)
            shown = alpha[faced.pixel]
            counts = faced.cosine**STRAIGHT * (shown > SOLID)
            on_black = color[faced.pixel] / np.maximum(shown, SOLID)[:, None]  # without the background's share
            total[faced.texel] += counts[:, None] * np.nan_to_num(on_black)
            weight[faced.texel] += counts
            task.advance()
    seen = weight > 1e-9
    return np.divide(total, weight[:, None], out=np.zeros_like(total), where=seen[:, None]), seen


def _cameras(body: Body, body_pose: BodyPose) -> Iterator[Camera]:
    vertices, pelvis = body.pose(body_pose), body.posed_joints(body_pose)[:1]
    framing = Framing.of([vertices], [0], pelvis, stand_of(body, body_pose, up_axis([body_pose])))
    for height in HEIGHTS:
        for k in range(AROUND):
            yield framing.camera(0, 360 * k / AROUND, PICTURE, PICTURE, height)
    for height in POLES:
        yield framing.camera(0, 0.0, PICTURE, PICTURE, height)


def _filled(texels: Texels, colors: Array, known: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """[R, R, 3] with every texel that has no colour, beside the charts too, in that of the nearest one that has."""
    side = texels.resolution
    flat, mask = np.zeros((side * side, 3)), np.zeros(side * side, bool)
    mask[texels.index[known]] = True
    flat[texels.index[known]] = colors[known]
    if not mask.any():
        return np.full((side, side, 3), 127, np.uint8)
    return displayed(flat[nearest_on_chart(mask.reshape(side, side))].clip(0, 1))
