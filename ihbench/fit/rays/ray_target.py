"""What a step needs of a training view whose rays go through a field in the root's frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from ihbench.body import Body
from ihbench.body.pose import BodyPose
from ihbench.camera import Camera
from ihbench.nets.bone_maps import root_frame
from ihbench.nets.motion_weights import MARGIN, joint_box
from ihbench.render.volumes.intervals import box_interval
from ihbench.render.volumes.rays import pixel_rays
from ihbench.scene.contracts import MaskState, TrainView

Array = NDArray[np.float64]
Unknown = Literal["background", "ignore"]
BOX_MARGIN = 0.01  # m by which rays' ends lie beyond the box (HumanNeRF, camera_util.py:162-208)


@dataclass(frozen=True)
class PosedBox:
    """Where a posed person can be: a box along the axes of the root's frame, around the posed joints."""

    frame: tuple[Array, Array]  # R [3, 3], t [3] m: a point p of the world is R p + t in the root's frame
    low: Array  # [3] m
    high: Array  # [3] m

    @classmethod
    def around(cls, body: Body, body_pose: BodyPose, margin: float = MARGIN) -> PosedBox:
        """The joints' box, grown by the margin and by what the released code adds for the rays' ends."""
        R, t = frame = root_frame(body_pose, body.shaped(body_pose.betas)[1])
        joints = torch.from_numpy(body.posed_joints(body_pose) @ R.T + t)
        low, high = joint_box(joints, margin + BOX_MARGIN)
        return cls(frame, low.numpy(), high.numpy())

    def ends(self, dtype: torch.dtype, device: torch.device | str) -> tuple[torch.Tensor, torch.Tensor]:
        """Low and high corner [3] m as tensors."""
        low, high = (torch.from_numpy(each).to(device, dtype) for each in (self.low, self.high))
        return low, high


@dataclass(frozen=True)
class RayTarget:
    """A training view as a method takes its mask. Arrays of pixels: steps draw some of them."""

    camera: Camera
    body_pose: BodyPose
    number: int  # of the training view
    box: PosedBox
    image: NDArray[np.float32]  # [H, W, 3] in [0, 1]; what is no person's is not to be looked at
    person: NDArray[np.bool_]  # [H, W] visible person
    unknown: NDArray[np.bool_]  # [H, W] not compared: all False where a method takes hidden pixels for background
    in_box: NDArray[np.bool_]  # [H, W] pixels whose ray meets the box
    person_pixels: NDArray[np.int32]  # [P] their numbers, row by row
    empty_pixels: NDArray[np.int32]  # [E] of those in the box that are known, or taken, to be background

    @property
    def shape(self) -> tuple[int, int]:
        return self.person.shape[0], self.person.shape[1]


def ray_target(
    view: TrainView, number: int, body: Body, unknown: Unknown = "background", margin: float = MARGIN
) -> RayTarget:
    """`unknown` says what a hidden pixel is: background like any other, as systems that know two states have it, or
    nothing that is compared."""
    box = PosedBox.around(body, view.body_pose, margin)
    person = view.mask == MaskState.PERSON
    hidden = (view.mask == MaskState.UNKNOWN) & (unknown == "ignore")
    in_box = meets_box(view.camera, box)
    return RayTarget(
        camera=view.camera,
        body_pose=view.body_pose,
        number=number,
        box=box,
        image=np.asarray(view.image, np.float32) / np.float32(255),
        person=person,
        unknown=hidden,
        in_box=in_box,
        person_pixels=np.flatnonzero(person).astype(np.int32),
        empty_pixels=np.flatnonzero(in_box & ~person & ~hidden).astype(np.int32),
    )


def meets_box(camera: Camera, box: PosedBox) -> NDArray[np.bool_]:
    """[H, W] pixels whose ray meets the box before the camera."""
    number = np.arange(camera.height * camera.width)
    rays = pixel_rays(camera, number // camera.width, number % camera.width, box.frame)
    near, far = box_interval(rays, *box.ends(torch.float32, "cpu"))
    return (near < far).numpy().reshape(camera.height, camera.width)
