"""What a step needs of a training view: its pixels by class, their colours, and the rays near the body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, distance_transform_edt
from torch import Tensor

from ihbench.body import Body
from ihbench.camera import Camera
from ihbench.fit.body_box import body_box
from ihbench.methods.wild2avatar.person.near_body import near_body
from ihbench.render.zbuffer import rasterize
from ihbench.scene.contracts import MaskState, TrainView

IN_BOX = 0.9  # of the rays, evenly in the window around the projected body; the others in all of the image


@dataclass(frozen=True)
class Target:
    """All by pixel, row-major."""

    camera: Camera
    row: int  # of the frame's tables
    colours: Tensor  # [P, 3] as filmed where the occluder is real, else the view's image
    coloured: Tensor  # [P] bool, where a colour is known
    person: Tensor  # [P] bool, visible
    unknown: Tensor  # [P] bool
    background: Tensor  # [P] bool, known or `beside_visible`
    body: Tensor  # [P] bool: the posed body covers it
    near: Tensor  # [P] m, see `near_body`
    far: Tensor  # [P] m
    box: tuple[int, int, int, int]  # x0, y0, width, height px around the projected body
    center: Tensor  # [3] m, the middle of the posed body's box
    reach: float  # m of the farthest vertex from it
    finite: bool  # all known colours are

    def draw(self, count: int, rng: np.random.Generator) -> Tensor:
        """[count] int64, pixels drawn by chance, most of them in the box."""
        inside = round(IN_BOX * count)
        x0, y0, width, height = self.box
        column = np.append(rng.integers(x0, x0 + width, inside), rng.integers(0, self.camera.width, count - inside))
        row = np.append(rng.integers(y0, y0 + height, inside), rng.integers(0, self.camera.height, count - inside))
        return torch.from_numpy(row * self.camera.width + column).to(self.near.device)


def middle(
    vertices: NDArray[np.float64],  # [V, 3] m
) -> NDArray[np.float64]:
    """[3] m, of the box around a posed body: the frame's centre."""
    return (vertices.min(0) + vertices.max(0)) / 2


def beside_visible(
    body: NDArray[np.bool_],  # [H, W] the posed body covers it
    mask: NDArray[np.uint8],  # [H, W] MaskState
) -> NDArray[np.bool_]:
    """[H, W] bool: pixels off the body, next to a part of it that is seen. The mask of a real occluder leaves them
    unknown, since clothes may stand off a body; clothes there would be as visible as what they are on. Without the
    neighbours of visible person, which show both."""
    if not body.any():
        return np.zeros_like(body)
    person = mask == MaskState.PERSON
    rows, columns = np.asarray(distance_transform_edt(~body, return_distances=False, return_indices=True))
    around = np.asarray(binary_dilation(person, np.ones((3, 3))), bool)
    return ~body & ~around & person[rows, columns]


def prepare_target(view: TrainView, row: int, body: Body, filmed: bool, device: torch.device) -> Target:
    """`filmed`: with the colours of occluder and room, where they are known."""
    camera = view.camera
    vertices = body.pose(view.body_pose)
    covered = rasterize(camera.project(vertices), body.faces, camera.height, camera.width).mask
    near, far = near_body(camera, vertices, device)
    photograph = view.filmed if filmed else None
    image = view.image if photograph is None else photograph
    unknown = view.mask == MaskState.UNKNOWN
    coloured = ~unknown if photograph is None else np.ones_like(unknown)
    center = middle(vertices)

    def pixels(chosen: NDArray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(chosen).reshape(-1)).to(device)

    return Target(
        camera=camera,
        row=row,
        colours=pixels(image.astype(np.float32) / 255).reshape(-1, 3),
        coloured=pixels(coloured),
        person=pixels(view.mask == MaskState.PERSON),
        unknown=pixels(unknown),
        background=pixels((view.mask == MaskState.BACKGROUND) | (unknown & beside_visible(covered, view.mask))),
        body=pixels(covered),
        near=near,
        far=far,
        box=body_box(camera, vertices).window,
        center=torch.from_numpy(center).float().to(device),
        reach=float(np.linalg.norm(vertices - center, axis=1).max()),
        finite=bool(np.isfinite(image[coloured]).all()),
    )
