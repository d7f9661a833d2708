"""Extreme Gaussians for both CPU back ends of the splat renderer, against the formula that defines a picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench.camera import Camera
from ihbench.stress.case import Answer, Case, words_of

BACKENDS = ("reference", "numba")
Scene = Sequence[Any]  # means [N, 3], scales [N], colours [N, C]
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
    scene: Scene, view: Camera | None = None, background: Any = (1.0, 1.0, 1.0), dtype: str = "float64"
) -> NDArray[np.float64]:
    """[2, H, W, C + 1] of each back end: the colour, then alpha."""
    import torch

    from ihbench.render.splat import render_gaussians

    m, s, c = (torch.as_tensor(np.asarray(x)).to(getattr(torch, dtype)) for x in scene)
    images = [render_gaussians(m, s, c, view or camera(), background, backend) for backend in BACKENDS]
    return torch.stack([torch.cat([rgb, alpha[..., None]], -1) for rgb, alpha in images]).double().numpy()


def gradients(
    scene: Scene, view: Camera | None = None, backends: Sequence[str] = BACKENDS, plain: bool = False
) -> NDArray[np.float64]:
    """[B, N, 4 + C] of each back end, along places, scales and colours: of a random weighting of the picture's pixels
    and of its alpha, or of the plain sum of its colours."""
    import torch

    from ihbench.render.splat import render_gaussians

    out = []
    for backend in backends:
        leaves = [torch.tensor(x).requires_grad_() for x in scene]
        rgb, alpha = render_gaussians(leaves[0], leaves[1], leaves[2], view or camera(), backend=backend)
        pull = torch.randn(*rgb.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64).to(rgb.dtype)
        (rgb.sum() if plain else (rgb * pull).sum() + alpha.square().sum()).backward()
        along = [torch.zeros_like(x) if x.grad is None else x.grad for x in leaves]
        out.append(torch.cat([g.reshape(len(leaves[0]), -1) for g in along], 1))
    return torch.stack(out).double().numpy()


def alpha_of(mean: tuple[float, float, float], scale: float, view: Camera) -> NDArray[np.float64]:
    """[H, W] alpha of one Gaussian, by the formula."""
    focal = view.K[0, 0]
    u, v = (focal * mean[k] / mean[2] + view.K[k, 2] for k in range(2))
    variance = (focal * scale / mean[2]) ** 2 + LOW_PASS
    y, x = np.mgrid[: view.height, : view.width] + 0.5
    alpha = np.minimum(np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * variance)), ALPHA_MAX)
    return np.where(alpha < ALPHA_MIN, 0.0, alpha)


def _cloud(count: int) -> tuple[NDArray, NDArray, NDArray]:
    rng = np.random.default_rng(0)
    means = rng.uniform(-0.5, 0.5, (count, 3)) + np.array([0, 0, 2.0])
    return means, rng.uniform(0.01, 0.08, count), rng.uniform(size=(count, 3))


def _one(scale: float, mean: tuple[float, float, float] = (0.013, -0.021, 2.0), focal: float = 40.0) -> Answer:
    """A single Gaussian's alpha. Its condition: what a relative change of the scale does to the variance, halved."""
    view = camera(focal=focal)
    spread = (focal * scale / mean[2]) ** 2
    got = draw(([mean], [scale], [[0.2, 0.5, 0.9]]), view)[..., 3]
    return Answer(got, alpha_of(mean, scale, view), spread / (spread + LOW_PASS))


def _not_drawn(mean: tuple[float, float, float], scale: float = 0.1) -> Answer:
    """Nothing but background."""
    return Answer(draw(([mean], [scale], [[0.5] * 3])), NOTHING)


def _barely_before(factor: float) -> Answer:
    """On one side of the near plane the splat fills the view, on the other there is none."""
    z = float(np.float32(NEAR)) * factor
    return Answer(draw(([[0.0, 0.0, z]], [0.1], [[0.5] * 3]))[..., 3], ALPHA_MAX if factor > 1 else 0.0)


def _stack(count: int, scale: float = 0.3) -> Answer:
    """Layers of ever lighter grey, one behind the other over one pixel, composited in float64."""
    depth = 2 + np.arange(count) / count
    colors = np.linspace(0, 1, count)[:, None].repeat(3, 1)
    means = np.stack([np.zeros(count), np.zeros(count), depth], -1)
    view = camera(1, 1)
    alphas = np.array([alpha_of((0.0, 0.0, float(z)), scale, view)[0, 0] for z in depth])
    left = np.concatenate([[1.0], np.cumprod(1 - alphas)])
    grey = float((alphas * left[:-1] * colors[:, 0]).sum() + left[-1])
    return Answer(draw((means, np.full(count, scale), colors), view), [grey] * 3 + [1 - left[-1]])


def _thin_stack(count: int) -> Answer:
    """Thousands of layers whose alpha is barely above the threshold: none may be dropped, the sum is a power."""
    view = camera(1, 1)
    alpha, depth = 1.05 * ALPHA_MIN, 2.0
    # so far beside the pixel that alpha is just this
    shift = math.sqrt(2 * (0.3**2 * 400 + LOW_PASS) * math.log(1 / alpha)) * depth / 40
    means = np.tile([shift, 0.0, depth], (count, 1))
    left = (1 - alpha_of((shift, 0.0, depth), 0.3, view)[0, 0]) ** count
    return Answer(draw((means, np.full(count, 0.3), np.zeros((count, 3))), view), [left] * 3 + [1 - left])


def _coincident(gap: float) -> Answer:
    """Two Gaussians at one depth, or nearer to each other than float32 can tell: the lower index is in front."""
    got = draw(([[0.0, 0.0, 2.0 + gap], [0.0, 0.0, 2.0]], [0.3, 0.3], [[1.0, 0, 0], [0, 0, 1.0]]))
    return Answer(got[:, 10, 12, 0], ALPHA_MAX + (1 - ALPHA_MAX) ** 2)


def _one_bad(field: int, bad: float) -> Answer:
    """One Gaussian of 40 has a value that is not finite: the picture is that of the other 39."""
    spoiled = _cloud(40)
    spoiled[field][7] = bad
    return Answer(draw(spoiled), draw([np.delete(x, 7, 0) for x in _cloud(40)]))


def _bad_gradient() -> Answer:
    """Its gradient is zero, and everybody else's is what it is without it."""
    spoiled = _cloud(40)
    spoiled[0][7, 0] = math.nan
    alone = gradients([np.delete(x, 7, 0) for x in _cloud(40)])
    return Answer(gradients(spoiled), np.insert(alone, 7, 0.0, axis=1))


def _twins(scene: Scene, scale: float | None = None, **options: Any) -> Answer:
    """Numba against the float64 twin."""
    twin, fast = draw(scene, **options)
    return Answer(fast, twin, scale=scale)


def _permuted() -> Answer:
    order = np.random.default_rng(1).permutation(200)
    return Answer(draw([x[order] for x in _cloud(200)]), draw(_cloud(200)))


def _threads() -> Answer:
    import torch

    before, got = torch.get_num_threads(), []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            got.append(gradients(_cloud(300), camera(70, 50), ["numba"]))
    finally:
        torch.set_num_threads(before)
    return Answer(got[0], got[1])


def _half() -> Answer:
    scene = [x.astype(np.float16) for x in _cloud(60)]
    return Answer(draw(scene, dtype="float16"), draw(scene))


def _white_on_black() -> Answer:
    got = draw((*_cloud(60)[:2], np.ones((60, 3))), background=(0.0, 0.0, 0.0))
    return Answer(got[..., :3], got[..., 3:])


def _far_world() -> Answer:
    """Positions are float64 until they are pixels."""
    (means, *looks), view, shift = _cloud(60), camera(), np.array([1e6, -1e6, 1e6])
    moved = replace(view, t=view.t - shift)
    return Answer(draw((means + shift, *looks), moved), draw((means, *looks)), condition=1e6 / 0.5)


def _backward(seed: int) -> Answer:
    """Relative error along means, scales and colours of a figure; the twin's own are 0."""
    from ihbench.kernels.splats import body_gaussians, compare_with_twin

    errors = compare_with_twin(body_gaussians(4000, 48, seed), "numba")
    return Answer(list(errors.gradient.values()), 0.0, note=f"image: {errors.image:.1e}")


def _gradient_of_one(scale: float, color: Sequence[float], view: Camera, plain: bool) -> NDArray[np.float64]:
    """[B, 1, 7] of a Gaussian in float32 on the camera's axis."""
    scene = [np.array(x, np.float32) for x in ([[0.0, 0.0, 2.0]], [scale], [color])]
    return gradients(scene, view, plain=plain)


def _saturated_gradient() -> Answer:
    """Where alpha is clamped, moving the splat changes nothing: the gradient of its place is 0, of its colour not."""
    got = _gradient_of_one(5.0, (0.2, 0.4, 0.6), camera(1, 1), plain=True)
    return Answer(got, [0, 0, 0, 0, ALPHA_MAX, ALPHA_MAX, ALPHA_MAX])


def _no_scale_gradient() -> Answer:
    """Only the low-pass is drawn; its derivative along the scale is 0 and not 0/0."""
    return Answer(_gradient_of_one(0.0, (0.5, 0.5, 0.5), camera(), plain=False)[..., 3], 0.0)


def _refused(words: str, scene: Scene, view: Camera | None = None) -> Answer:
    return Answer(words_of(ValueError, lambda: draw(scene, view)), words)


_splat = partial(Case, group="splat")
_exact = partial(_splat, unit="absolute", tolerance=0, why=EXACT)
_single = partial(_splat, unit="absolute", tolerance=2e-6, why=FLOAT32)
_drawn = partial(_splat, unit="absolute", tolerance=1e-5, why=FLOAT32)
_same_bits = partial(_splat, unit="absolute", tolerance=0, why=BITS)
_refusal = partial(_splat, unit="words", tolerance=0)


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
           lambda: Answer(draw((np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)))), NOTHING)),
    _exact("splat-all-behind-gradient", "gradients when all are behind",
           lambda: Answer(gradients(([[0.0, 0, -1], [0, 0, -2]], [1.0, 1.0], [[1.0] * 3] * 2)), 0.0)),
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
    # squared they would be drawn; but they make another picture
    _refusal("splat-negative-scale", "logarithms of scales", why="they must be refused", version=2,
             function=lambda: _refused("go through exp()", (_cloud(40)[0], np.log(_cloud(40)[1]), _cloud(40)[2]))),
    *(
        _drawn(f"splat-{w}x{h}", f"an image of {w}×{h} px", lambda w=w, h=h: _twins(_cloud(60), view=camera(w, h)))
        for w, h in ((1, 1), (17, 33))
    ),
    _same_bits("splat-permuted", "another order of the input", _permuted),
    _same_bits("splat-threads", "gradients on one thread and on two", _threads),
    _splat("splat-hdr", "colours of 10000",
           lambda: _twins((*_cloud(60)[:2], _cloud(60)[2] * 1e4), scale=1e4), "relative", 1e-5, FLOAT32),
    _drawn("splat-64-channels", "colours of 64 channels",
           lambda: _twins((*_cloud(60)[:2], np.random.default_rng(2).uniform(size=(60, 64))), background=(0.3,))),
    _splat("splat-float16", "inputs in half precision", _half, "absolute", 1e-3, "the picture is rounded to float16"),
    _single("splat-white-on-black", "white on black is alpha", _white_on_black),
    _drawn("splat-far-world", "a scene 1000 km from the origin", _far_world,
           why=FLOAT32 + "; a centre keeps 1e-10 m of 1e6"),
    _splat("splat-backward", "gradients of 4000 Gaussians against the twin", partial(_backward, 0), "absolute", 2e-5,
           GRADIENT),
    _splat("splat-saturated-gradient", "gradients under the alpha clamp", _saturated_gradient, "absolute", 1e-6,
           FLOAT32),
    _exact("splat-zero-scale-gradient", "the gradient of a scale of 0", _no_scale_gradient),
    _refusal("splat-distorted-camera", "a camera with lens distortion", why="it must be refused",
             function=lambda: _refused("expected no lens distortion", _cloud(2),
                                       replace(camera(), distortion=np.array([0.1, 0, 0, 0, 0])))),
]  # fmt: skip
