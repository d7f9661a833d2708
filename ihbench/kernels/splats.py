"""Splat back ends: times, memory, and the error of images and gradients against the float64 twin."""

from __future__ import annotations

import math
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
# case, Gaussians, px, opacity, ratio of the longest to the shortest axis
GENERAL_CASES = (
    ("5k@128 o1", 5_000, 128, 1.0, 1.0),
    ("20k@256 o.5 1:5", 20_000, 256, 0.5, 5.0),
    ("50k@512 o1 1:5", 50_000, 512, 1.0, 5.0),
    ("50k@512 o.5 1:5", 50_000, 512, 0.5, 5.0),
    ("50k@512 o.1 1:5", 50_000, 512, 0.1, 5.0),
)
LARGE_CASES = (("200k@1024 o.5 1:5", 200_000, 1024, 0.5, 5.0), ("500k@1024 o.5 1:5", 500_000, 1024, 0.5, 5.0))
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


def general_gaussians(count: int, size: int, opacity: float, ratio: float, seed: int = 0) -> Gaussians:
    """The figure of `body_gaussians` from ellipsoids of one opacity, longest to shortest axis 1:`ratio`, each of the
    volume of the sphere that it stands for and turned at random."""
    import torch

    spheres = body_gaussians(count, size, seed)
    generator = torch.Generator().manual_seed(seed)
    spheres = replace(spheres, opacities=torch.full((count,), opacity), preset="3dgs")
    if ratio == 1:  # a sphere has no gradient along its turn that an error could be relative to
        return spheres
    along = torch.tensor([0.5, 0.0, -0.5]) * math.log(ratio)
    quaternions = torch.randn(count, 4, generator=generator)
    return replace(spheres, scales=spheres.scales[:, None] * along.exp(), quaternions=quaternions)


def splat_rows(repeats: int, cases: Sequence[tuple[str, int, int]] = SPLAT_CASES) -> list[Row]:
    """Every splat back end that can run here, on every case; the twin is timed once, on the smallest."""
    rows = []
    for case, count, size in cases:
        rows += _rows_of("splat", case, body_gaussians(count, size), repeats, twin=case == cases[0][0])
    return rows


def general_splat_rows(
    repeats: int, cases: Sequence[tuple[str, int, int, float, float]] = GENERAL_CASES
) -> list[Row]:
    """The same for general Gaussians: opacity, ellipsoids."""
    rows = []
    for case, count, size, opacity, ratio in cases:
        scene = general_gaussians(count, size, opacity, ratio)
        rows += _rows_of("splat-general", case, scene, repeats, twin=case == cases[0][0])
    return rows


def large_splat_rows(repeats: int) -> list[Row]:
    """Sizes that take their time; only where they are asked for by name."""
    return [replace(row, kernel="splat-large") for row in general_splat_rows(repeats, LARGE_CASES)]


def _rows_of(kernel: str, case: str, scene: Gaussians, repeats: int, twin: bool) -> list[Row]:
    import torch

    on = {"cpu": scene}
    if torch.cuda.is_available():
        on["cuda"] = replace(scene, **{name: x.cuda() for name, x in scene.tensors().items()})
    backends = ["numba", *(["gsplat"] if "cuda" in on and find_spec("gsplat") is not None else [])]
    processor: dict[str, list[float]] = {}

    def step(backend: str) -> tuple[float, float]:
        scene = on["cuda" if backend == "gsplat" else "cpu"]
        leaves = {name: x.detach().requires_grad_() for name, x in scene.tensors().items()}
        pull = torch.ones(scene.camera.height, scene.camera.width, 3, device=scene.means.device)
        _synchronize(scene.means)
        start, busy = time.perf_counter(), time.process_time()
        rgb, _ = scene.draw(leaves, backend)
        _synchronize(rgb)
        middle = time.perf_counter()
        rgb.backward(pull)
        _synchronize(rgb)
        processor.setdefault(backend, []).append((time.process_time() - busy) * 1e3)
        return (middle - start) * 1e3, (time.perf_counter() - middle) * 1e3

    timings = interleave({b: lambda b=b: step(b) for b in backends}, repeats)
    if twin:
        timings |= interleave({"reference": lambda: step("reference")}, 1, warm_up=0)
    pairs = pixel_pairs(scene)
    rows = []
    for backend, samples in timings.items():
        image = gradient = 0.0
        if backend != "reference":
            errors = compare_with_twin(_window(on["cuda" if backend == "gsplat" else "cpu"]), backend)
            image, gradient = errors.image, max(errors.gradient.values())
        memory = peak_mib(lambda b=backend: step(b)) if backend == "numba" else None
        spent = processor[backend][: -1 if memory is not None else None][-repeats:]  # the last one was for the memory
        row = row_of(kernel, case, backend, samples, memory, image, gradient)
        seconds = (row.forward_ms + (row.backward_ms or 0.0)) / 1e3
        rows.append(replace(row, processor_ms=float(np.median(spent)), pairs_per_second=pairs / seconds))
    return rows


def pixel_pairs(scene: Gaussians) -> float:
    """Pixels that the footprints cover, all splats together, inside the image or not, hidden or not: what a renderer
    without any skipping would draw."""
    from ihbench.render.splat import project_gaussians
    from ihbench.render.splats import PRESETS, as_ellipses

    rules = PRESETS[scene.preset]
    s = as_ellipses(
        project_gaussians(
            scene.means, scene.scales, scene.colors.flatten(1)[:, :1], scene.camera, quaternions=scene.quaternions,
            opacities=scene.opacities, preset=scene.preset,
        )
    )  # fmt: skip
    xx, both, yy = s.covariance.unbind(1)
    cut = 2 * (s.opacity.double() / rules.alpha_min).clamp(min=1).log()
    return float((math.pi * cut * (xx * yy - both * both).sqrt()).sum())


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
