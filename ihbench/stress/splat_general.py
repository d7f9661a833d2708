"""Extreme general Gaussians (covariance, opacity, spherical harmonics) for both CPU back ends, against the formulas
that define a picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench.camera import Camera
from ihbench.stress.case import Answer, Case, words_of
from ihbench.stress.splat import ALPHA_MIN, BACKENDS, BITS, EXACT, FLOAT32, GRADIENT, LOW_PASS, NOTHING, camera

# what the renderer is defined to do (gsplat 1.6); not imported, so that a change is noticed
CEILING = {"opaque": 0.999, "3dgs": 0.99}
CLAMP = 0.3
AT = (0.013, -0.021, 2.0)  # m, nearly on the axis
GREY = (0.2, 0.5, 0.9)


def draw(
    means: Any,
    spread: Any,  # scales [N] or [N, 3], or covariances
    colors: Any,
    view: Camera | None = None,
    outputs: Sequence[str] = ("rgb", "alpha"),
    background: Any = (1.0, 1.0, 1.0),
    backends: Sequence[str] = BACKENDS,
    preset: Any = "3dgs",
    sh_degree: int | None = None,
    **tensors: Any,
) -> NDArray[np.float64]:
    """[B, H, W, …] of each back end: the outputs' channels beside each other, from float64."""
    import torch

    from ihbench.render.splat import render_gaussians

    m, s, c = (torch.as_tensor(np.asarray(x, np.float64)) for x in (means, spread, colors))
    given = {name: torch.as_tensor(np.asarray(x, np.float64)) for name, x in tensors.items()}
    pictures = [
        render_gaussians(
            m,
            s,
            c,
            view or camera(),
            background,
            backend,
            **given,
            preset=preset,
            outputs=outputs,
            sh_degree=sh_degree,
        )
        for backend in backends
    ]
    return torch.stack([torch.cat([x.reshape(*x.shape[:2], -1) for x in p], -1) for p in pictures]).numpy()


def alpha_of(
    mean: Sequence[float], covariance: NDArray, opacity: float, view: Camera, preset: str
) -> NDArray[np.float64]:
    """[H, W] alpha of one Gaussian before an unturned camera, by the formula."""
    x, y, z = mean
    f, cx, cy = view.K[0, 0], view.K[0, 2], view.K[1, 2]
    clamped = [
        np.clip(a / z, -c / f - CLAMP * side / 2 / f, (side - c) / f + CLAMP * side / 2 / f)
        for a, c, side in ((x, cx, view.width), (y, cy, view.height))
    ]
    J = np.array([[f, 0, -f * clamped[0]], [0, f, -f * clamped[1]]]) / z
    inverse = np.linalg.inv(J @ covariance @ J.T + LOW_PASS * np.eye(2))
    rows, columns = np.mgrid[: view.height, : view.width] + 0.5
    d = np.stack([columns - (f * x / z + cx), rows - (f * y / z + cy)], -1)
    alpha = np.minimum(opacity * np.exp(-np.einsum("hwi,ij,hwj->hw", d, inverse, d) / 2), CEILING[preset])
    return np.where(alpha < ALPHA_MIN, 0.0, alpha)


def _axes(quaternion: Sequence[float]) -> NDArray[np.float64]:
    """[3, 3] rotation of (w, x, y, z), by Rodrigues' formula."""
    q = np.array(quaternion) / np.linalg.norm(quaternion)
    angle, axis = 2 * math.atan2(np.linalg.norm(q[1:]), q[0]), q[1:] / max(np.linalg.norm(q[1:]), 1e-300)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def _one(
    scales: Sequence[float],
    quaternion: Sequence[float] = (1, 0, 0, 0),
    opacity: float = 0.8,
    mean: Sequence[float] = AT,
    preset: str = "3dgs",
    view: Camera | None = None,
) -> Answer:
    """A single Gaussian's alpha."""
    view = view or camera()
    got = draw([mean], [scales], [GREY], view, preset=preset, quaternions=[quaternion], opacities=[opacity])
    axes = _axes(quaternion)
    return Answer(got[..., 3], alpha_of(mean, axes @ np.diag(np.square(scales)) @ axes.T, opacity, view, preset))


def _covariance(matrix: NDArray, opacity: float = 0.8) -> Answer:
    got = draw([AT], [matrix], [GREY], opacities=[opacity])
    return Answer(got[..., 3], alpha_of(AT, matrix, opacity, camera(), "3dgs"))


def _not_drawn(spread: Any, opacity: float = 0.8, mean: Sequence[float] = AT, **tensors: Any) -> Answer:
    return Answer(draw([mean], [spread], [GREY], opacities=[opacity], **tensors), NOTHING)


def _layers(opacity: float, count: int, preset: str) -> Answer:
    """Layers over one pixel, front to back: alpha, and the depth they add up to."""
    view, depth = camera(1, 1), 2.0 + np.arange(count)
    left, alpha, accumulated = 1.0, min(opacity, CEILING[preset]), 0.0
    for z in depth:
        if preset == "3dgs" and left * (1 - alpha) <= 1e-4:
            break
        accumulated += left * alpha * z
        left *= 1 - alpha
    means = np.stack([0 * depth, 0 * depth, depth], 1)
    got = draw(
        means, np.full(count, 1.0), np.full((count, 3), 0.5), view, ("alpha", "depth"), preset=preset,
        opacities=np.full(count, opacity),
    )  # fmt: skip
    return Answer(got[:, 0, 0], [1 - left, accumulated])


def _harmonic(index: int, direction: Sequence[float], value: float) -> Answer:
    """One coefficient of 0.5 in every channel, seen along a direction: 0.5 + 0.5 × the basis function."""
    toward = np.array(direction, np.float64) / np.linalg.norm(direction)
    coefficients = np.zeros((1, 16, 3))
    coefficients[0, index] = 0.5
    view = camera(1, 1)
    # the Gaussian stays on the axis; the world is turned so that it lies along the direction
    side = np.cross(toward, [0.3, -0.5, 0.8])
    side /= np.linalg.norm(side)
    turned = Camera(view.K, np.stack([side, np.cross(toward, side), toward]), np.zeros(3), 1, 1)
    got = draw([2 * toward], [[[0.04 if i == j else 0 for j in range(3)] for i in range(3)]], coefficients, turned,
               ("rgb",), (0.0,), sh_degree=3, opacities=[0.5])  # fmt: skip
    return Answer(got, 0.5 * max(0.0, 0.5 + 0.5 * value))


def _cloud(count: int, seed: int = 0) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    return {
        "means": rng.uniform(-0.5, 0.5, (count, 3)) + np.array([0, 0, 2.0]),
        "spread": rng.uniform(0.01, 0.08, (count, 3)),
        "colors": rng.uniform(size=(count, 3)),
        "quaternions": rng.normal(size=(count, 4)),
        "opacities": rng.uniform(0.01, 1, count),
    }


def _twins(scene: dict[str, Any], view: Camera | None = None, **options: Any) -> Answer:
    twin, fast = draw(**scene, view=view, outputs=("rgb", "alpha", "depth"), **options)
    return Answer(fast, twin)


def _pieces(number: int) -> dict[str, Any]:
    """Everything of a cloud but one Gaussian, and a NaN in place of it."""
    spoiled = _cloud(40)
    spoiled[list(spoiled)[number]][7] = math.nan
    return spoiled


def _one_bad(number: int) -> Answer:
    without: dict[str, Any] = {name: np.delete(x, 7, 0) for name, x in _cloud(40).items()}
    return Answer(draw(**_pieces(number)), draw(**without))


def _permuted() -> Answer:
    order = np.random.default_rng(1).permutation(200)
    permuted: dict[str, Any] = {name: x[order] for name, x in _cloud(200).items()}
    return Answer(draw(**permuted), draw(**_cloud(200)))


def _gradient(preset: str, stretch: float) -> Answer:
    """Relative error of the gradients along everything; the twin's own are 0."""
    import torch

    from ihbench.kernels.splats import Gaussians, compare_with_twin

    cloud = _cloud(150)
    cloud["spread"][:, 0] *= stretch
    tensors: dict[str, Any] = {name: torch.tensor(x, dtype=torch.float32) for name, x in cloud.items()}
    scene = Gaussians(scales=tensors.pop("spread"), camera=camera(), preset=preset, **tensors)  # pyright: ignore[reportArgumentType]
    errors = compare_with_twin(scene, "numba")
    return Answer(list(errors.gradient.values()), 0.0, note=f"image: {errors.image:.1e}")


def _screen_radius() -> Answer:
    import torch

    from ihbench.render.splat import render_gaussians

    (screen,) = render_gaussians(
        torch.tensor([[0.0, 0, 2], [9, 0, 2], [0, 0, -1]]), torch.full((3,), 0.2), torch.ones(3, 3), camera(),
        opacities=torch.full((3,), 0.3), outputs=("screen",),
    )  # fmt: skip
    return Answer(screen.radius.numpy(), [math.sqrt(2 * math.log(255 * 0.3) * (16 + LOW_PASS)), 0, 0])


def _far_world() -> Answer:
    cloud, view, shift = _cloud(60), camera(), np.array([1e6, -1e6, 1e6])
    moved = Camera(view.K, view.R, view.t - shift, view.width, view.height)
    return Answer(draw(**(cloud | {"means": cloud["means"] + shift}), view=moved), draw(**cloud), condition=2e6)


def _refused(words: str, **changes: Any) -> Answer:
    return Answer(words_of(ValueError, lambda: draw(**(_cloud(3) | changes))), words)


_case = partial(Case, group="splat")
_single = partial(_case, unit="absolute", tolerance=3e-6, why=FLOAT32)
_drawn = partial(_case, unit="absolute", tolerance=3e-5, why=FLOAT32 + "; depths up to 3")
_exact = partial(_case, unit="absolute", tolerance=0, why=EXACT)
_bits = partial(_case, unit="absolute", tolerance=0, why=BITS)
_refusal = partial(_case, unit="words", tolerance=0, why="it must be refused")
TURNED = (0.9, 0.1, -0.3, 0.25)
SIN_45 = math.sqrt(0.5)

CASES = [
    _single("splat-ellipse", "an ellipsoid at an angle", partial(_one, (0.2, 0.05, 0.1), TURNED)),
    _single("splat-needle-flat", "a needle of 1:1000 along a row", partial(_one, (1.0, 1e-3, 1e-3))),
    _single("splat-needle-steep", "a needle of 1:1000 at 45°",
            partial(_one, (1.0, 1e-3, 1e-3), (math.cos(math.pi / 8), 0, 0, math.sin(math.pi / 8)))),
    _single("splat-needle-depth", "a needle of 1:1000 along the axis", partial(_one, (1e-3, 1e-3, 1.0))),
    _single("splat-disc", "a disc of thickness 0", partial(_one, (0.2, 0.2, 0.0), TURNED)),
    _single("splat-rank-one", "a covariance of rank 1",
            lambda: _covariance(np.outer((0.2, 0.1, 0.3), (0.2, 0.1, 0.3)))),
    _single("splat-point", "a covariance of 0: only the low-pass is left", lambda: _covariance(np.zeros((3, 3)))),
    _single("splat-long-quaternion", "a quaternion of length 1e3",
            partial(_one, (0.2, 0.05, 0.1), tuple(1e3 * q for q in TURNED))),
    _single("splat-minus-quaternion", "the opposite quaternion is the same turn",
            partial(_one, (0.2, 0.05, 0.1), tuple(-q for q in TURNED))),
    _single("splat-half-turn", "a turn by 180°", partial(_one, (0.2, 0.05, 0.1), (0.0, SIN_45, SIN_45, 0.0))),
    _single("splat-off-axis", "a sphere 20° off the axis is wider across",
            lambda: _one((0.1,) * 3, mean=(2 * math.tan(math.radians(20)), 0.0, 2.0), view=camera(60, 20))),
    _single("splat-clamped", "a sphere far beside the image: the off-axis terms are clamped",
            partial(_one, (0.6,) * 3, mean=(2.5, 0.1, 2.0))),
    _single("splat-faint", "an opacity of 1/50", partial(_one, (0.2, 0.05, 0.1), TURNED, 0.02)),
    _single("splat-ceiling-3dgs", "opacity 1 draws .99 under \"3dgs\"", partial(_one, (0.5, 0.4, 0.3), TURNED, 1.0)),
    _single("splat-ceiling-opaque", "opacity 1 draws .999 under \"opaque\"",
            partial(_one, (0.5, 0.4, 0.3), TURNED, 1.0, preset="opaque")),
    _exact("splat-too-faint", "an opacity just under 1/255",
           lambda: _not_drawn((0.2,) * 3, 0.999 / 255, quaternions=[TURNED])),
    _exact("splat-no-opacity", "an opacity of 0", lambda: _not_drawn((0.2,) * 3, 0.0, quaternions=[TURNED])),
    _exact("splat-ellipse-behind", "an ellipsoid behind the camera",
           lambda: _not_drawn((0.2,) * 3, mean=(0.0, 0.0, -2.0), quaternions=[TURNED])),
    _exact("splat-indefinite", "a covariance that is none: correlation 3",
           lambda: _not_drawn([[1.0, 3, 0], [3, 1, 0], [0, 0, 1]])),
    *(
        _single(f"splat-layers-{preset}-{opacity}", f"six layers of opacity {opacity} under \"{preset}\"",
                partial(_layers, opacity, 6, preset), tolerance=3e-5, why=FLOAT32 + "; depths up to 7 m")
        for preset, opacity in (("3dgs", 0.5), ("3dgs", 0.95), ("opaque", 0.95), ("opaque", 1.0))
    ),
    *(
        _single(f"splat-harmonic-{index}", f"coefficient {index} of the spherical harmonics along {direction}",
                partial(_harmonic, index, direction, value))
        for index, direction, value in (
            (0, (1, 2, 3), 0.5 / math.sqrt(math.pi)),
            (1, (0, 1, 0), -math.sqrt(3 / (4 * math.pi))),
            (2, (0, 0, 1), math.sqrt(3 / (4 * math.pi))),
            (4, (1, 1, 0), math.sqrt(15 / (4 * math.pi)) / 2),
            (6, (0, 0, 1), math.sqrt(5 / math.pi) / 2),
            (12, (0, 0, -1), -math.sqrt(7 / math.pi) / 2),
            (15, (1, 0, 0), -math.sqrt(35 / (2 * math.pi)) / 4),
        )
    ),
    *(
        _case(f"splat-general-bad-{what}", f"one {what} of NaN among 40 general Gaussians", partial(_one_bad, number),
              "absolute", 0, "the same Gaussians in the same order")
        for number, what in ((0, "mean"), (1, "scale"), (3, "quaternion"), (4, "opacity"))
    ),
    _drawn("splat-general-17x33", "general Gaussians on 17×33 px", lambda: _twins(_cloud(80), camera(17, 33))),
    _drawn("splat-general-130x40", "general Gaussians across tiles", lambda: _twins(_cloud(80), camera(130, 40))),
    _drawn("splat-general-large", "splats of 100 px that stop",
           lambda: _twins(_cloud(60) | {"spread": np.full((60, 3), 1.0), "opacities": np.full(60, 0.9)})),
    _drawn("splat-general-far-world", "general Gaussians 1000 km from the origin", _far_world),
    _bits("splat-general-permuted", "another order of general Gaussians", _permuted),
    *(
        _case(f"splat-general-gradient-{preset}-{stretch}", f"gradients under \"{preset}\", stretched {stretch}",
              partial(_gradient, preset, stretch), "absolute", 2e-5, GRADIENT)
        for preset, stretch in (("3dgs", 1), ("opaque", 30))
    ),
    _single("splat-radius", "the radius on the screen", _screen_radius, tolerance=1e-5),
    _refusal("splat-logits", "logits of opacities",
             function=lambda: _refused("go through sigmoid()", opacities=[-2.0, 0.3, 4.0])),
    _refusal("splat-unknown-preset", "an unknown preset", function=lambda: _refused("splat preset", preset="inria")),
    _refusal("splat-few-harmonics", "too few coefficients",
             function=lambda: _refused("[N, 16 or more, 3]", colors=np.zeros((3, 9, 3)), sh_degree=3)),
]  # fmt: skip
