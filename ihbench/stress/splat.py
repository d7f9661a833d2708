"""Extreme Gaussians for both CPU back ends of the splat renderer, against the formula that defines a picture."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ihbench.camera import Camera
from ihbench.stress.case import Answer, Case, words_of

if TYPE_CHECKING:
    from torch import Tensor

BACKENDS = ("reference", "numba")
# what the renderer is defined to do (Kerbl et al. 2023, released code); not imported, so that a change is noticed
NEAR, LOW_PASS, ALPHA_MAX, ALPHA_MIN = 0.01, 0.3, 0.999, 1 / 255

NOTHING = [1.0, 1.0, 1.0, 0.0]  # white, without alpha

FLOAT32 = "the fast back end draws in float32: one exponential, one product and one sum a layer"
STACK = "the fast back end leaves out what lies behind a transmittance of 1e-5"
EXACT = "the definition gives this and nothing else"
BITS = "the order of work must not show"
GRADIENT = "float32 sums over thousands of pixels and splats, relative to the norm of the gradient"


def camera(width: int = 24, height: int = 20, focal: float = 40.0) -> Camera:
    """At the origin, looking along z through the centre of a pixel."""
    K = np.array([[focal, 0, width // 2 + 0.5], [0, focal, height // 2 + 0.5], [0, 0, 1]])
    return Camera(K, np.eye(3), np.zeros(3), width, height)


def draw(
    means: Any, scales: Any, colors: Any, view: Camera | None = None, background: Any = (1.0, 1.0, 1.0),
    dtype: str = "float64",
) -> list[NDArray]:  # fmt: skip
    """[H, W, C + 1] of each back end: the colour, then alpha."""
    import torch

    from ihbench.render.splat import render_gaussians

    m, s, c = (torch.as_tensor(np.asarray(x)).to(getattr(torch, dtype)) for x in (means, scales, colors))
    images = [render_gaussians(m, s, c, view or camera(), background, backend) for backend in BACKENDS]
    return [torch.cat([rgb, alpha[..., None]], -1).double().numpy() for rgb, alpha in images]


def alpha_of(mean: tuple[float, float, float], scale: float, view: Camera) -> NDArray[np.float64]:
    """[H, W] alpha of one Gaussian, by the formula."""
    focal = view.K[0, 0]
    u, v = (focal * mean[k] / mean[2] + view.K[k, 2] for k in range(2))
    variance = (focal * scale / mean[2]) ** 2 + LOW_PASS
    y, x = np.mgrid[: view.height, : view.width] + 0.5
    alpha = np.minimum(np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * variance)), ALPHA_MAX)
    return np.where(alpha < ALPHA_MIN, 0.0, alpha)


def _one(scale: float, mean: tuple[float, float, float] = (0.013, -0.021, 2.0), focal: float = 40.0) -> Answer:
    """A single Gaussian's alpha. Its condition: what a relative change of the scale does to the variance, halved."""
    view = camera(focal=focal)
    alpha = alpha_of(mean, scale, view)
    spread = (focal * scale / mean[2]) ** 2
    condition = spread / (spread + LOW_PASS)
    return Answer(np.stack(draw([mean], [scale], [[0.2, 0.5, 0.9]], view))[..., 3], alpha, condition)


def _not_drawn(mean: tuple[float, float, float], scale: float = 0.1) -> Answer:
    """Nothing but background."""
    return Answer(np.stack(draw([mean], [scale], [[0.5] * 3])), NOTHING)


def _barely_before(factor: float) -> Answer:
    """On one side of the near plane the splat fills the view, on the other there is none."""
    z = float(np.float32(NEAR)) * factor
    alpha = ALPHA_MAX if factor > 1 else 0.0
    return Answer(np.stack(draw([[0.0, 0.0, z]], [0.1], [[0.5] * 3]))[..., 3], alpha)


def _nothing_to_move() -> Answer:
    """Gradients of a scene that is all behind the camera are zeros, one for every Gaussian."""
    import torch

    got = []
    for backend in BACKENDS:
        leaves = _leaves(torch.tensor([[0.0, 0, -1], [0, 0, -2]]), torch.ones(2), torch.ones(2, 3))
        got += [g.flatten() for g in _gradients(leaves, camera(), backend)]
    return Answer(torch.cat(got).numpy(), 0.0)


def _leaves(*tensors: Tensor) -> list[Tensor]:
    return [x.detach().clone().requires_grad_() for x in tensors]


def _gradients(leaves: list[Tensor], view: Camera, backend: str) -> list[Tensor]:
    """Of a random weighting of the picture's pixels."""
    import torch

    from ihbench.render.splat import render_gaussians

    rgb, alpha = render_gaussians(leaves[0], leaves[1], leaves[2], view, backend=backend)
    generator = torch.Generator().manual_seed(0)
    pull = torch.randn(*rgb.shape, generator=generator, dtype=torch.float64).to(rgb.dtype)
    ((rgb * pull).sum() + alpha.square().sum()).backward()
    return [torch.zeros_like(x) if x.grad is None else x.grad for x in leaves]


def _stack(count: int, scale: float = 0.3) -> Answer:
    """Layers of ever lighter grey, one behind the other over one pixel, composited in float64."""
    depth = 2 + np.arange(count) / count
    colors = np.linspace(0, 1, count)[:, None].repeat(3, 1)
    means = np.stack([np.zeros(count), np.zeros(count), depth], -1)
    view = camera(1, 1)
    alphas = np.array([alpha_of((0.0, 0.0, float(z)), scale, view)[0, 0] for z in depth])
    left = np.concatenate([[1.0], np.cumprod(1 - alphas)])
    grey = float((alphas * left[:-1] * colors[:, 0]).sum() + left[-1])
    return Answer(np.stack(draw(means, np.full(count, scale), colors, view)), [grey] * 3 + [1 - left[-1]])


def _thin_stack(count: int) -> Answer:
    """Thousands of layers whose alpha is barely above the threshold: none may be dropped, the sum is a power."""
    view = camera(1, 1)
    alpha, depth = 1.05 * ALPHA_MIN, 2.0
    # so far beside the pixel that alpha is just this
    shift = math.sqrt(2 * (0.3**2 * 400 + LOW_PASS) * math.log(1 / alpha)) * depth / 40
    means = np.tile([shift, 0.0, depth], (count, 1))
    left = (1 - alpha_of((shift, 0.0, depth), 0.3, view)[0, 0]) ** count
    return Answer(np.stack(draw(means, np.full(count, 0.3), np.zeros((count, 3)), view)), [left] * 3 + [1 - left])


def _coincident(gap: float) -> Answer:
    """Two Gaussians at one depth, or nearer to each other than float32 can tell: the lower index is in front."""
    means = [[0.0, 0.0, 2.0 + gap], [0.0, 0.0, 2.0]]
    got = np.stack(draw(means, [0.3, 0.3], [[1.0, 0, 0], [0, 0, 1.0]]))
    return Answer(got[:, 10, 12, 0], ALPHA_MAX + (1 - ALPHA_MAX) ** 2)


def _one_bad(field: int, bad: float) -> Answer:
    """One Gaussian of 40 has a value that is not finite: the picture is that of the other 39."""
    means, scales, colors = _cloud(40)
    spoiled = [means.copy(), scales.copy(), colors.copy()]
    spoiled[field][7] = bad
    others = np.delete(np.arange(40), 7)
    return Answer(
        np.stack(draw(spoiled[0], spoiled[1], spoiled[2])),
        np.stack(draw(means[others], scales[others], colors[others])),
    )


def _bad_gradient() -> Answer:
    """Its gradient is zero, and everybody else's is what it is without it."""
    import torch

    means, scales, colors = (torch.from_numpy(x) for x in _cloud(40))
    others = torch.tensor([k for k in range(40) if k != 7])
    got, expected = [], []
    for backend in BACKENDS:
        spoiled = means.clone()
        spoiled[7, 0] = math.nan
        gradients = _gradients(_leaves(spoiled, scales, colors), camera(), backend)
        alone = _gradients(_leaves(means[others], scales[others], colors[others]), camera(), backend)
        for g, a in zip(gradients, alone, strict=True):
            got += [g[7].flatten(), g[others].flatten()]
            expected += [torch.zeros_like(g[7]).flatten(), a.flatten()]
    return Answer(torch.cat(got).numpy(), torch.cat(expected).numpy())


def _cloud(count: int, seed: int = 0) -> tuple[NDArray, NDArray, NDArray]:
    rng = np.random.default_rng(seed)
    means = rng.uniform(-0.5, 0.5, (count, 3)) + np.array([0, 0, 2.0])
    return means, rng.uniform(0.01, 0.08, count), rng.uniform(size=(count, 3))


def _negative_scale() -> Answer:
    """Squared they would be drawn; but they are logarithms, which make another picture."""
    means, scales, colors = _cloud(40)
    return Answer(words_of(ValueError, lambda: draw(means, np.log(scales), colors)), "go through exp()")


def _twins(*scene: Any, scale: float | None = None, **options: Any) -> Answer:
    """Numba against the float64 twin."""
    twin, fast = draw(*scene, **options)
    return Answer(fast, twin, scale=scale)


def _permuted() -> Answer:
    means, scales, colors = _cloud(200)
    order = np.random.default_rng(1).permutation(200)
    return Answer(np.stack(draw(means[order], scales[order], colors[order])), np.stack(draw(means, scales, colors)))


def _threads() -> Answer:
    """One thread against two, image and gradients, to the bit."""
    import torch

    leaves = [torch.from_numpy(x) for x in _cloud(300)]
    before, got = torch.get_num_threads(), []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            gradients = _gradients(_leaves(*leaves), camera(70, 50), "numba")
            got.append(torch.cat([g.flatten() for g in gradients]).numpy())
    finally:
        torch.set_num_threads(before)
    return Answer(got[0], got[1])


def _hdr() -> Answer:
    """Colours of 1e4: errors are relative to them."""
    means, scales, colors = _cloud(60)
    return _twins(means, scales, colors * 1e4, scale=1e4)


def _channels(count: int) -> Answer:
    means, scales, _ = _cloud(60)
    colors = np.random.default_rng(2).uniform(size=(60, count))
    return _twins(means, scales, colors, background=(0.3,))


def _half() -> Answer:
    """Inputs in float16: the picture of the rounded inputs, in float16."""
    means, scales, colors = (x.astype(np.float16) for x in _cloud(60))
    expected = draw(means.astype(np.float64), scales.astype(np.float64), colors.astype(np.float64))
    return Answer(np.stack(draw(means, scales, colors, dtype="float16")), np.stack(expected))


def _white_on_black() -> Answer:
    """What a white Gaussian leaves on black is alpha."""
    means, scales, colors = _cloud(60)
    got = np.stack(draw(means, scales, np.ones_like(colors), background=(0.0, 0.0, 0.0)))
    return Answer(got[..., :3], got[..., 3:])


def _far_world() -> Answer:
    """The same scene a thousand kilometres from the world's origin: positions are float64 until they are pixels."""
    means, scales, colors = _cloud(60)
    shift = np.array([1e6, -1e6, 1e6])
    view = camera()
    moved = Camera(view.K, view.R, view.t - shift, view.width, view.height)
    return Answer(
        np.stack(draw(means + shift, scales, colors, moved)), np.stack(draw(means, scales, colors)),
        condition=1e6 / 0.5,
    )  # fmt: skip


def _backward(seed: int) -> Answer:
    """Gradients of a figure of 4000 Gaussians: relative error of means, scales and colours; the twin's own are 0."""
    from ihbench.kernels.splats import body_gaussians, compare_with_twin

    errors = compare_with_twin(body_gaussians(4000, 48, seed), "numba")
    return Answer(list(errors.gradient.values()), 0.0, note=f"image: {errors.image:.1e}")


def _saturated_gradient() -> Answer:
    """Where alpha is clamped, moving the splat changes nothing: the gradient of its place is 0, of its colour not."""
    import torch

    from ihbench.render.splat import render_gaussians

    view, got = camera(1, 1), []
    for backend in BACKENDS:
        leaves = _leaves(torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([5.0]), torch.tensor([[0.2, 0.4, 0.6]]))
        rgb, _ = render_gaussians(leaves[0], leaves[1], leaves[2], view, backend=backend)
        rgb.sum().backward()
        got.append(torch.cat([g.grad.flatten() for g in leaves if g.grad is not None]).double().numpy())
    return Answer(np.stack(got), [0, 0, 0, 0, ALPHA_MAX, ALPHA_MAX, ALPHA_MAX])


def _no_scale_gradient() -> Answer:
    """At scale 0 only the low-pass is drawn; its derivative along the scale is 0 and not 0/0."""
    import torch

    got = []
    for backend in BACKENDS:
        leaves = _leaves(torch.tensor([[0.0, 0.0, 2.0]]), torch.zeros(1), torch.ones(1, 3) / 2)
        got.append(_gradients(leaves, camera(), backend)[1].numpy())
    return Answer(np.stack(got), 0.0)


def _distorted() -> Answer:
    view = camera()
    lens = Camera(view.K, view.R, view.t, view.width, view.height, np.array([0.1, 0, 0, 0, 0]))
    return Answer(words_of(ValueError, lambda: draw(*_cloud(2), lens)), "expected no lens distortion")


_splat = partial(Case, group="splat")
_exact = partial(_splat, unit="absolute", tolerance=0, why=EXACT)
_single = partial(_splat, unit="absolute", tolerance=2e-6, why=FLOAT32)
_same_bits = partial(_splat, unit="absolute", tolerance=0, why=BITS)


CASES = [
    _single("splat-plain", "a Gaussian of 2 px", partial(_one, 0.1)),
    _single("splat-sub-pixel", "a scale of 1e-6 m: only the low-pass is left", partial(_one, 1e-6)),
    _single("splat-zero-scale", "a scale of 0", partial(_one, 0.0)),
    _single("splat-huge", "a scale of 1 km: the clamp everywhere", partial(_one, 1e3)),
    _single("splat-huge-1e15", "a footprint of 1e33 px², which float32 just holds", partial(_one, 1e15)),
    _exact("splat-overflow", "a footprint that float32 lacks is not drawn",
           partial(_not_drawn, (0.0, 0.0, 2.0), 1e19)),
    _single("splat-focal-1e5", "a focal length of 1e5 px at 100 m", partial(_one, 1e-3, (0.004, -0.003, 100.0), 1e5)),
    _single("splat-far-away", "a Gaussian at 1e7 m", partial(_one, 1e5, (3e5, -2e5, 1e7))),
    _single("splat-alpha-ceiling", "the middle of an opaque Gaussian lets 1/1000 through",
            partial(_one, 0.5, (0.0, 0.0, 2.0))),
    _exact("splat-behind", "a centre behind the camera", partial(_not_drawn, (0.0, 0.0, -2.0))),
    _exact("splat-on-camera", "a centre in the camera", partial(_not_drawn, (0.0, 0.0, 0.0))),
    _single("splat-before-near", "an ulp of float32 before the near plane", partial(_barely_before, 1 + 2.0**-22)),
    _exact("splat-behind-near", "an ulp of float32 behind the near plane", partial(_barely_before, 1 - 2.0**-22)),
    _exact("splat-beside", "a centre far beside the image", partial(_not_drawn, (50.0, 0.0, 2.0))),
    _exact("splat-none", "no Gaussian at all",
           lambda: Answer(np.stack(draw(np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)))), NOTHING)),
    _exact("splat-all-behind-gradient", "gradients when all are behind", _nothing_to_move),
    _splat("splat-stack-100", "100 opaque layers over one pixel", partial(_stack, 100), "absolute", 1.2e-5, STACK),
    _splat("splat-stack-10000", "10000 opaque layers over one pixel", partial(_stack, 10_000), "absolute", 1.2e-5,
           STACK),
    _splat("splat-stack-thin", "2000 layers at 1.05 times the alpha threshold", partial(_thin_stack, 2000),
           "absolute", 2e-5, STACK + "; 2000 products in float32"),
    _single("splat-coincident", "two centres in one place", partial(_coincident, 0.0)),
    _single("splat-depth-tie", "two depths that float32 cannot tell apart", partial(_coincident, 1e-8)),
    *(
        _splat(f"splat-bad-{what}", f"one {what} of {bad} among 40 Gaussians", partial(_one_bad, field, bad),
               "absolute", 0, "the same Gaussians in the same order")
        for what, field, bad in (("mean", 0, math.nan), ("scale", 1, math.inf), ("colour", 2, math.nan))
    ),
    _splat("splat-bad-gradient", "gradients beside a centre of NaN", _bad_gradient, "absolute", 1e-12,
           "float64 in the twin, the same float32 sums in the fast one"),
    _splat("splat-negative-scale", "logarithms of scales", _negative_scale, "words", 0, "they must be refused",
           version=2),
    *(
        _splat(f"splat-{w}x{h}", f"an image of {w}×{h} px", lambda w=w, h=h: _twins(*_cloud(60), camera(w, h)),
               "absolute", 1e-5, FLOAT32)
        for w, h in ((1, 1), (17, 33))
    ),
    _same_bits("splat-permuted", "another order of the input", _permuted),
    _same_bits("splat-threads", "gradients on one thread and on two", _threads),
    _splat("splat-hdr", "colours of 10000", _hdr, "relative", 1e-5, FLOAT32),
    _splat("splat-64-channels", "colours of 64 channels", partial(_channels, 64), "absolute", 1e-5, FLOAT32),
    _splat("splat-float16", "inputs in half precision", _half, "absolute", 1e-3, "the picture is rounded to float16"),
    _single("splat-white-on-black", "white on black is alpha", _white_on_black),
    _splat("splat-far-world", "a scene 1000 km from the origin", _far_world, "absolute", 1e-5,
           FLOAT32 + "; a centre keeps 1e-10 m of 1e6"),
    _splat("splat-backward", "gradients of 4000 Gaussians against the twin", partial(_backward, 0), "absolute", 2e-5,
           GRADIENT),
    _splat("splat-saturated-gradient", "gradients under the alpha clamp", _saturated_gradient, "absolute", 1e-6,
           FLOAT32),
    _exact("splat-zero-scale-gradient", "the gradient of a scale of 0", _no_scale_gradient),
    _splat("splat-distorted-camera", "a camera with lens distortion", _distorted, "words", 0, "it must be refused"),
]  # fmt: skip
