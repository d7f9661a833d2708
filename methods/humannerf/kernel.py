"""The volume renderer on a fitted HumanNeRF: what skipping saves, and what it costs in the picture."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ihbench.body.pose import BodyPose
from ihbench.camera import Camera
from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.fit.rays.ray_target import PosedBox
from ihbench.kernels.measuring import Row, Sample, interleave, peak_mib, row_of, timed
from ihbench.methods.humannerf.avatar import HumanNerfAvatar, PosedField
from ihbench.methods.humannerf.config import QUICK, in_steps
from ihbench.methods.humannerf.fitting import HumanNerfFit
from ihbench.render.volumes.fast import Skipping, box_rays, draw_image, march
from ihbench.render.volumes.intervals import even_depths, segment_lengths
from ihbench.render.volumes.rays import Rays
from ihbench.render.volumes.reference import dense_rays, reference_rays
from ihbench.scene.contracts import TrainingSet

SIZE, SAMPLES = 64, 128  # px of the picture, samples of a ray
FITTED, FITTED_PX = 100, 64  # steps of the fit before, and its images
TWIN_RAYS = 32  # that the float64 twin looks at, of those that show something; its time is extrapolated
PATCH = 16  # px: side of the patch that goes forward and back
CHUNK = 1024  # rays of the dense renderer at a time
WHITE = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Scene:
    """A fitted person in a natural pose, and the rays of a picture that meet its box."""

    avatar: HumanNerfAvatar
    pose: BodyPose
    camera: Camera
    box: PosedBox
    rays: Rays
    depths: Tensor  # [N, S] m
    lengths: Tensor  # [N, S] m

    @property
    def field(self) -> PosedField:
        return self.avatar.posed(self.pose, corrected=False)


@cache
def fitted(steps: int = FITTED) -> HumanNerfAvatar:
    """Six sides of a drawn person, fitted with the networks of the quick profile."""
    from ihbench.stress.drawn_capture import a_camera, a_pose, the_body, train_view

    views = [
        train_view(a_camera(0.0, FITTED_PX), a_pose(1.05 * k, 0.3 * float(np.sin(k))), frame=k) for k in range(6)
    ]
    config = replace(in_steps(QUICK, steps), lpips=0.0, mse=1.0, lr=5e-3, lr_motion=5e-3, least=1e-3)
    avatar = HumanNerfAvatar(config, the_body(), np.zeros(10), 0)
    HumanNerfFit(avatar, TrainingSet(views, the_body(), WHITE, "kernel"), 0, Ledger()).run(Progress.silent())
    return avatar


def scene_of(avatar: HumanNerfAvatar, size: int = SIZE) -> Scene:
    """An avatar in a natural pose."""
    from ihbench.stress.drawn_capture import a_camera, a_pose

    pose, camera = a_pose(0.5, 0.2), a_camera(0.3, size)
    box = PosedBox.around(avatar.body, pose)
    parts = list(box_rays(camera, box.ends(torch.float32, "cpu"), box.frame))
    rays = Rays(torch.cat([part[1].origins for part in parts]), torch.cat([part[1].directions for part in parts]))
    near, far = torch.cat([part[2] for part in parts]), torch.cat([part[3] for part in parts])
    depths = even_depths(near, far, SAMPLES)
    return Scene(avatar, pose, camera, box, rays, depths, segment_lengths(depths, rays.lengths))


def volume_rows(repeats: int) -> list[Row]:
    """A picture by the fast renderer, by the dense one and by the float64 twin, and a patch forward and back by the
    first two. Value errors are the largest of colours on white against the twin's, on rays that show something;
    gradient errors are those of all parameters against the dense renderer's in float64, relative to their norm."""
    scene = scene_of(fitted())
    return [*_picture(scene, repeats), *_patch(scene, repeats)]


def _picture(scene: Scene, repeats: int) -> list[Row]:
    field, config = scene.field, scene.avatar.config
    exact = copy.deepcopy(scene.avatar).double().posed(scene.pose, corrected=False)
    ends = scene.box.ends(torch.float32, "cpu")
    skip = Skipping(config.least, config.stop)

    def fast() -> Tensor:
        return draw_image(field, scene.camera, ends, SAMPLES, WHITE, scene.box.frame, skip).rgb.flatten(0, 1)

    @torch.no_grad()
    def dense() -> Tensor:
        plain = replace(field, by_torch=True)
        shown = torch.ones(scene.camera.height * scene.camera.width, 3)
        parts = zip(*(x.split(CHUNK) for x in (numbers, scene.depths, scene.lengths)), strict=True)
        for first, (pixels, depths, lengths) in enumerate(parts):
            rays = scene.rays[slice(first * CHUNK, first * CHUNK + len(pixels))]
            shown[pixels] = dense_rays(plain, rays, depths, lengths).on(torch.ones(3))
        return shown

    numbers = torch.cat([part[0] for part in box_rays(scene.camera, ends, scene.box.frame)])
    plain = dense()
    seen = ((plain[numbers] < 0.95).any(1)).nonzero()[:, 0]
    chosen = seen[torch.linspace(0, len(seen) - 1, TWIN_RAYS).long()]
    rays = Rays(scene.rays.origins[chosen].double(), scene.rays.directions[chosen].double())
    start = time.perf_counter()
    with torch.no_grad():
        rgb, alpha, _ = reference_rays(exact, rays, scene.depths[chosen].double(), scene.lengths[chosen].double())
    twin_ms = (time.perf_counter() - start) * 1e3 * len(numbers) / len(chosen)
    truth = rgb + (1 - alpha)[:, None]
    steps: dict[str, Callable[[], Any]] = {"fast f32": fast, f"dense {SAMPLES} torch f32": dense}
    timings: dict[str, list[Sample]] = interleave(
        {name: lambda f=f: timed(f) for name, f in steps.items()}, repeats, warm_up=1
    )
    case, rows = f"picture {scene.camera.width}², {len(numbers)} rays", []
    for name, samples in timings.items():
        error = float((steps[name]()[numbers[chosen]] - truth).abs().max())
        rows.append(row_of("volume", case, name, samples, peak_mib(steps[name]), error))
    return [*rows, row_of("volume", case, "twin f64, extrapolated", [(twin_ms, None)], None, 0.0)]


def _patch(scene: Scene, repeats: int) -> list[Row]:
    """A patch in the middle of the person."""
    size = scene.camera.width
    ends = scene.box.ends(torch.float32, "cpu")
    numbers = torch.cat([part[0] for part in box_rays(scene.camera, ends, scene.box.frame)])
    rows, columns = numbers // size, numbers % size
    inside = ((rows - size // 2).abs() < PATCH // 2) & ((columns - size // 2).abs() < PATCH // 2)
    some = inside.nonzero()[:, 0]

    def gradients(avatar: HumanNerfAvatar, way: str) -> tuple[Sample, list[Tensor], Tensor]:
        avatar.zero_grad(set_to_none=True)
        start = time.perf_counter()
        field, like = avatar.posed(scene.pose, corrected=False), avatar.canonical.last.weight
        rays = Rays(scene.rays.origins[some].to(like), scene.rays.directions[some].to(like))
        depths, lengths = scene.depths[some].to(like), scene.lengths[some].to(like)
        if way == "fast":
            shown = march(field, rays, depths, lengths, avatar.config.least).composited
        else:
            shown = dense_rays(replace(field, by_torch=True), rays, depths, lengths)
        colors = shown.on(torch.ones(3).to(like))
        middle = time.perf_counter()
        (colors - 0.5).square().mean().backward()
        times = (middle - start) * 1e3, (time.perf_counter() - middle) * 1e3
        return times, [p.grad.double() for p in avatar.parameters() if p.grad is not None], colors.detach().double()

    _, exact, truth = gradients(copy.deepcopy(scene.avatar).double(), "dense")
    steps = {name: lambda way=way: gradients(scene.avatar, way)[0]
             for name, way in (("fast f32", "fast"), (f"dense {SAMPLES} torch f32", "dense"))}  # fmt: skip
    timings = interleave(steps, repeats, warm_up=1)
    out = []
    for name, samples in timings.items():
        _, own, colors = gradients(scene.avatar, name.split()[0])
        off = torch.stack([(a - b).norm() for a, b in zip(own, exact, strict=True)]).norm()
        relative = float(off / torch.stack([b.norm() for b in exact]).norm())
        error = float((colors - truth).abs().max())
        out.append(
            row_of("volume", f"patch {PATCH}², and back", name, samples, peak_mib(steps[name]), error, relative)
        )
    return out
