"""Splat back ends: times, memory, and the error of images and gradients against the float64 twin."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import TYPE_CHECKING, Literal

import numpy as np

from ihbench.camera import Camera, look_at
from ihbench.kernels.measuring import Row, interleave, peak_mib, row_of

if TYPE_CHECKING:
    from torch import Tensor

SPLAT_CASES = (("5k@128", 5_000, 128), ("20k@256", 20_000, 256), ("50k@512", 50_000, 512), ("200k@512", 200_000, 512))
NO_GRADIENT = 1e-12  # a scene of clamped alphas has gradients of 1e-30; they mean 0
WINDOW = 64  # px; side of the window in which the float64 twin is drawn


@dataclass(frozen=True)
class Gaussians:
    """A scene for the splat renderer."""

    means: Tensor  # [N, 3] m
    scales: Tensor  # [N] or [N, 3] m, or covariances [N, 3, 3] m²
    colors: Tensor  # [N, 3], or spherical harmonics [N, K, 3]
    camera: Camera
    quaternions: Tensor | None = None  # [N, 4]
    opacities: Tensor | None = None  # [N]
    sh_degree: int | None = None
    preset: Literal["opaque", "3dgs"] = "opaque"

    def tensors(self) -> dict[str, Tensor]:
        """What is given, by name."""
        names = ("means", "scales", "colors", "quaternions", "opacities")
        return {name: getattr(self, name) for name in names if getattr(self, name) is not None}

    def draw(
        self, leaves: dict[str, Tensor], backend: str, background: Sequence[float] = (1.0, 1.0, 1.0)
    ) -> tuple[Tensor, Tensor]:
        """The picture and its alpha, with tensors of these names instead of its own."""
        from ihbench.render.splat import render_gaussians

        first, options = dict(list(leaves.items())[:3]), dict(list(leaves.items())[3:])
        return render_gaussians(
            **first, camera=self.camera, background=background, backend=backend, **options, sh_degree=self.sh_degree,
            preset=self.preset,
        )  # fmt: skip


@dataclass(frozen=True)
class SplatErrors:
    """A splat back end against the float64 twin; `at_threshold` is about the pixels that the rest leaves out."""

    image: float  # largest absolute error of colour and alpha
    gradient: dict[str, float]  # per tensor: norm of the difference over the norm
    gradient_element: dict[str, float]  # per tensor: largest |difference| / max(|value|, rms of the tensor)
    at_threshold: float  # share of pixels with an alpha so near a threshold that rounding decides
    image_at_threshold: float  # largest error there beyond what the splats at the threshold may cause


def body_gaussians(count: int, size: int, seed: int = 0) -> Gaussians:
    """A standing figure of six capsules with `count` Gaussians on its surface, seen by a size² camera, float32.

    It covers about a sixth of the image; a scale is about the distance between neighbours.
    """
    import torch

    # (centre of one end, centre of the other end) m, radius m: torso, head, legs, arms
    ends = np.array(
        [
            [(0.0, 0.55, 0.0), (0.0, 0.05, 0.0)],
            [(0.0, 0.75, 0.0), (0.0, 0.78, 0.0)],
            [(0.1, 0.0, 0.0), (0.13, -0.8, 0.0)],
            [(-0.1, 0.0, 0.0), (-0.13, -0.8, 0.0)],
            [(0.2, 0.5, 0.0), (0.5, 0.1, 0.05)],
            [(-0.2, 0.5, 0.0), (-0.5, 0.1, 0.05)],
        ]
    )
    radius = np.array([0.13, 0.1, 0.075, 0.075, 0.05, 0.05])
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    area = 2 * np.pi * radius * (length + 2 * radius)

    rng = np.random.default_rng(seed)
    part = rng.choice(len(radius), count, p=area / area.sum())
    axis = (ends[part, 1] - ends[part, 0]) / length[part, None]
    # a capsule's surface seen along its axis has the area of a cylinder over the same interval
    along = rng.uniform(-1, 1, count) * (length[part] / 2 + radius[part])
    over = np.clip(np.abs(along) - length[part] / 2, 0, None)
    direction = rng.normal(size=(count, 3))
    direction -= (direction * axis).sum(1, keepdims=True) * axis
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    means = ends[part].mean(1) + along[:, None] * axis
    means += np.sqrt(np.maximum(radius[part] ** 2 - over**2, 0))[:, None] * direction
    scales = np.sqrt(area.sum() / count) * rng.uniform(0.7, 1.1, count)

    R, t = look_at(np.array([0.5, 0.2, 2.1]), np.zeros(3))
    focal = 1.03 * size
    camera = Camera(np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]]), R, t, size, size)
    means, scales, colors = (
        torch.tensor(a, dtype=torch.float32) for a in (means, scales, rng.uniform(size=(count, 3)))
    )
    return Gaussians(means, scales, colors, camera)


def compare_with_twin(
    scene: Gaussians,
    backend: str,
    background: Sequence[float] = (1.0, 1.0, 1.0),
    seed: int = 0,
    tolerance: float = 1e-4,
) -> SplatErrors:
    """A back end's image and gradients against the float64 twin's, for random gradients of colour and alpha.

    Pixels with an alpha within `tolerance` of a threshold get no gradient, so that they are left out of the gradients
    of both; their colours are compared apart, each such splat being allowed one ALPHA_MIN.
    """
    import torch

    from ihbench.render.splat import project_gaussians
    from ihbench.render.splat_reference import alphas_near_threshold
    from ihbench.render.splats import ALPHA_MIN, PRESETS

    inputs, camera = scene.tensors(), scene.camera
    # colours do not move a threshold; spherical harmonics would have to be evaluated
    plain = scene.colors.flatten(1)[:, :1]
    splats = project_gaussians(
        scene.means, scene.scales, plain, camera, quaternions=scene.quaternions, opacities=scene.opacities,
        preset=scene.preset,
    )  # fmt: skip
    near = alphas_near_threshold(splats, camera.height, camera.width, tolerance, PRESETS[scene.preset])
    generator = torch.Generator(device="cpu").manual_seed(seed)
    pull_rgb = torch.randn(*near.shape, scene.colors.shape[-1], generator=generator, dtype=torch.float64)
    pull_alpha = torch.randn(*near.shape, generator=generator, dtype=torch.float64)
    device = scene.means.device
    pull_rgb, pull_alpha = (pull_rgb.to(device) * (near == 0)[..., None], pull_alpha.to(device) * (near == 0))

    def draw(which: str, dtype: torch.dtype) -> tuple[Tensor, list[Tensor]]:
        leaves = {name: x.detach().to(dtype).requires_grad_() for name, x in inputs.items()}
        rgb, alpha = scene.draw(leaves, which, background)
        gradients = torch.autograd.grad(
            [rgb, alpha], list(leaves.values()), [pull_rgb.to(dtype), pull_alpha.to(dtype)]
        )
        return torch.cat([rgb, alpha[..., None]], -1).detach().double(), [g.double() for g in gradients]

    image, gradients = draw(backend, scene.means.dtype)
    true_image, true_gradients = draw("reference", torch.float64)
    error = (image - true_image).abs().amax(-1)
    names = tuple(inputs)
    pairs = list(zip(gradients, true_gradients, strict=True))
    excess = (error - near * ALPHA_MIN)[near > 0]
    return SplatErrors(
        image=float(error[near == 0].max()) if (near == 0).any() else 0.0,
        gradient={n: _norm_error(g, truth) for n, (g, truth) in zip(names, pairs, strict=True)},
        gradient_element={n: _element_error(g, truth) for n, (g, truth) in zip(names, pairs, strict=True)},
        at_threshold=float((near > 0).double().mean()),
        image_at_threshold=max(0.0, float(excess.max())) if len(excess) else 0.0,
    )


def _norm_error(value: Tensor, truth: Tensor) -> float:
    """|value - truth| / |truth|, where a gradient under NO_GRADIENT counts as none."""
    return float((value - truth).norm() / truth.norm().clamp(min=NO_GRADIENT))


def _element_error(value: Tensor, truth: Tensor) -> float:
    """Largest |value - truth| / max(|truth|, rms of truth), where a gradient under NO_GRADIENT counts as none."""
    if truth.numel() == 0:
        return 0.0
    floor = max(float(truth.square().mean().sqrt()), NO_GRADIENT)
    return float(((value - truth).abs() / truth.abs().clamp(min=floor)).max())


def splat_rows(repeats: int, cases: Sequence[tuple[str, int, int]] = SPLAT_CASES) -> list[Row]:
    """Every splat back end that can run here, on every case; the twin is timed once, on the smallest."""
    import torch

    from ihbench.render.splat import render_gaussians

    rows = []
    for case, count, size in cases:
        scene = body_gaussians(count, size)
        on = {"cpu": scene}
        if torch.cuda.is_available():
            on["cuda"] = Gaussians(scene.means.cuda(), scene.scales.cuda(), scene.colors.cuda(), scene.camera)
        backends = ["numba", *(["gsplat"] if "cuda" in on and find_spec("gsplat") is not None else [])]

        def step(backend: str, scenes: dict[str, Gaussians] = on) -> tuple[float, float]:
            scene = scenes["cuda" if backend == "gsplat" else "cpu"]
            leaves = [x.detach().requires_grad_() for x in (scene.means, scene.scales, scene.colors)]
            pull = torch.ones(scene.camera.height, scene.camera.width, 3, device=scene.means.device)
            _synchronize(scene.means)
            start = time.perf_counter()
            rgb, _ = render_gaussians(leaves[0], leaves[1], leaves[2], scene.camera, backend=backend)
            _synchronize(rgb)
            middle = time.perf_counter()
            rgb.backward(pull)
            _synchronize(rgb)
            return (middle - start) * 1e3, (time.perf_counter() - middle) * 1e3

        timings = interleave({b: lambda b=b: step(b) for b in backends}, repeats)
        if case == cases[0][0]:
            timings |= interleave({"reference": lambda: step("reference")}, 1, warm_up=0)
        for backend, samples in timings.items():
            image = gradient = 0.0
            if backend != "reference":
                errors = compare_with_twin(_window(on["cuda" if backend == "gsplat" else "cpu"]), backend)
                image, gradient = errors.image, max(errors.gradient.values())
            memory = peak_mib(lambda b=backend: step(b)) if backend == "numba" else None
            rows.append(row_of("splat", case, backend, samples, memory, image, gradient))
    return rows


def _window(scene: Gaussians) -> Gaussians:
    """The same scene through a small window at the edge of the figure's torso, where the twin takes seconds."""
    size = scene.camera.width
    side = min(WINDOW, size)
    corner = min(int(0.38 * size), size - side)
    return replace(scene, camera=scene.camera.cropped(corner, corner, side, side))


def _synchronize(tensor: Tensor) -> None:
    if tensor.is_cuda:
        import torch

        torch.cuda.synchronize(tensor.device)
