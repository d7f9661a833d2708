"""The loops that project general Gaussians and their gradients, against the same in torch and central differences."""

import math

import numpy as np
import pytest
import torch

from ihbench.camera import Camera
from ihbench.render.splat import render_gaussians
from ihbench.render.splat_ellipses import ELLIPSE, ELLIPSE_GRADIENT, ellipse_gradients, ellipse_records
from ihbench.render.splat_gaussians import gaussian_gradients, project_gaussians
from ihbench.render.splat_numba import _view
from ihbench.render.splat_projection import covariances_of, project_ellipses
from ihbench.render.splats import PRESETS

RULES = PRESETS["3dgs"]
KINDS = ("spheres", "ellipsoids", "covariances")


def turned_camera():
    """With skew, turned and moved, fx != fy."""
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64))[0]
    R = (turn * torch.linalg.det(turn)).numpy()
    return Camera(np.array([[60.0, 1.5, 31], [0, 66, 25], [0, 0, 1]]), R, np.array([0.1, -0.2, 0.3]), 64, 48)


def world(kind, n, spread=1.5):
    """Means, shapes, quaternions, opacities, colors: float64, in and beside the image, some beyond the clamp."""
    rng = np.random.default_rng(7)
    camera = turned_camera()
    z = rng.uniform(1, 3, n)
    seen = np.stack([rng.uniform(-spread, spread, n) * z, rng.uniform(-spread, spread, n) * z, z], 1)
    means = torch.from_numpy((seen - camera.t) @ camera.R)
    scales = torch.from_numpy(np.exp(rng.uniform(-4, 0, (n, 3))))
    turns, opacities = torch.from_numpy(rng.normal(size=(n, 4))), torch.from_numpy(rng.uniform(0.1, 1, n))
    colors = torch.rand(n, 3, generator=torch.Generator().manual_seed(1))
    if kind == "spheres":
        return means, scales[:, 0].clone(), None, opacities, colors
    if kind == "covariances":
        lopsided = torch.from_numpy(rng.normal(size=(n, 3, 3))) * 1e-3  # only the symmetric half counts
        return means, covariances_of(scales, turns) + lopsided - lopsided.mT, None, opacities, colors
    return means, scales, turns, opacities, colors


def in_torch(means, shapes, turns, opacities, colors):
    covariances = shapes if shapes.ndim == 3 else covariances_of(shapes, turns)
    return project_ellipses(means, covariances, opacities, colors, turned_camera(), RULES)


def as_arrays(means, shapes, turns, opacities):
    turns = means.new_zeros(0, 4) if turns is None else turns
    return [x.contiguous().numpy() for x in (means, shapes.reshape(len(means), -1), turns, opacities)]


def project(means, shapes, turns, opacities, colors):
    n, camera = len(means), turned_camera()
    records, depth, radius = np.zeros((n, ELLIPSE), np.float32), np.empty(n, np.float32), np.zeros(n)
    project_gaussians(
        *as_arrays(means, shapes, turns, opacities), colors.numpy(), *_view(camera, RULES), RULES.low_pass,
        np.float32(RULES.near), RULES.alpha_min, camera.height, camera.width, records, depth, radius, 0, 1,
    )  # fmt: skip
    return records, depth, radius


@pytest.mark.parametrize("kind", KINDS)
def test_records_are_those_of_the_projection_in_torch(kind):
    inputs = world(kind, 300)
    inputs[0][:20] -= 4 * torch.tensor(turned_camera().R[2])  # behind
    records, depth, radius = project(*inputs)
    truth = in_torch(*inputs)
    expected, sight = np.zeros_like(records), truth.depth.numpy().copy()
    camera = turned_camera()
    ellipse_records(
        truth.xy.numpy(), truth.covariance.numpy(), truth.opacity.numpy(), truth.colors.numpy(), RULES.alpha_min,
        camera.height, camera.width, expected, sight, 0, 1,
    )  # fmt: skip
    sight[truth.depth.numpy() <= RULES.near] = 0
    assert np.allclose(depth, sight, rtol=1e-6)
    drawn = depth > 0
    assert 50 < drawn.sum() < 281
    assert np.allclose(records[drawn], expected[drawn], rtol=1e-5, atol=1e-5)
    assert ((radius > 0) <= drawn).all()
    assert (radius > 0).sum() > 50


def gradients(inputs, slots):
    """Of means, shapes, turns from slots [N, …], one a splat; and of xy, covariance, by the kernel for ellipses."""
    records, depth, _ = project(*inputs)
    n = len(depth)
    rank_of = np.where(depth > 0, np.arange(n), -1).astype(np.int32)
    arrays, start = as_arrays(*inputs[:4]), np.arange(n + 1, dtype=np.int32)
    found = [np.zeros_like(x) for x in arrays]
    colors, centers = np.zeros((n, 3), np.float32), np.zeros((n, 2))
    gaussian_gradients(
        slots,
        rank_of,
        start,
        records,
        *arrays,
        *_view(turned_camera(), RULES),
        0,
        True,
        *found,
        colors,
        centers,
        0,
        1,
    )
    splats = np.zeros((n, 2)), np.zeros((n, 3)), np.zeros(n), np.zeros((n, 3), np.float32)
    ellipse_gradients(slots, rank_of, start, records, arrays[3], 0, True, *splats, 0, 1)
    assert np.allclose(centers, splats[0], rtol=1e-9, atol=1e-12 * abs(splats[0]).max())
    assert np.allclose(found[3], splats[2], rtol=1e-12)
    assert (colors == slots[:, 6:9] * (rank_of >= 0)[:, None]).all()
    return found[:3], splats[:2]


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_are_those_of_the_projection_in_torch(kind):
    inputs = world(kind, 300)
    slots = np.random.default_rng(0).normal(size=(300, ELLIPSE_GRADIENT)).astype(np.float32)
    found, pulls = gradients(inputs, slots)
    leaves = [None if x is None else x.clone().requires_grad_() for x in inputs[:3]]
    splats = in_torch(*leaves, *inputs[3:])
    wanted = [x for x in leaves if x is not None]
    truth = torch.autograd.grad([splats.xy, splats.covariance], wanted, [torch.from_numpy(x) for x in pulls])
    for value, expected in zip(found, truth, strict=False):
        expected = expected.reshape(value.shape).numpy()
        scale = np.abs(expected).max(1, keepdims=True) + 1e-30
        assert (np.abs(value - expected) / scale).max() < 1e-9


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_are_central_differences(kind):
    inputs = world(kind, 4, 0.4)
    slots = np.random.default_rng(1).normal(size=(4, ELLIPSE_GRADIENT)).astype(np.float32)
    found, pulls = gradients(inputs, slots)

    def pulled(*tensors):
        splats = in_torch(*tensors, *inputs[3:])
        pairs = zip((splats.xy, splats.covariance), pulls, strict=True)
        return float(sum((x * torch.from_numpy(pull)).sum() for x, pull in pairs))

    for at, value in enumerate(found):
        for k in range(value.size):
            ends = []
            for step in (1e-6, -1e-6):
                moved = [None if x is None else x.clone() for x in inputs[:3]]
                moved[at].view(-1)[k] += step
                ends.append(pulled(*moved))
            assert (ends[0] - ends[1]) / 2e-6 == pytest.approx(
                value.ravel()[k], rel=1e-4, abs=1e-5 * abs(value).max()
            )


@pytest.mark.parametrize("kind", KINDS)
def test_float32_and_float64_draw_the_same(kind):
    means, shapes, turns, opacities, colors = world(kind, 60, 0.4)
    pictures = []
    for dtype in (torch.float32, torch.float64):
        given = [None if x is None else x.to(dtype).requires_grad_() for x in (means, shapes, turns, opacities)]
        rgb, screen = render_gaussians(
            given[0], given[1], colors.to(dtype), turned_camera(), backend="numba", quaternions=given[2],
            opacities=given[3], outputs=("rgb", "screen"),
        )  # fmt: skip
        rgb.square().sum().backward()
        assert screen.radius.dtype == screen.gradient.dtype == given[0].grad.dtype == dtype
        pictures.append([rgb, screen.radius, screen.gradient, *(x.grad for x in given if x is not None)])
    for single, double in zip(*pictures, strict=True):
        assert float((single.double() - double).detach().norm() / double.detach().norm()) < 1e-3


def test_a_quaternion_of_length_zero_turns_nothing():
    means, shapes, turns, opacities, colors = world("ellipsoids", 3, 0.3)
    turns[1] = 0
    records, _, _ = project(means, shapes, turns, opacities, colors)
    turns[1, 0] = 2.0
    assert np.array_equal(records, project(means, shapes, turns, opacities, colors)[0])


def test_circles_tell_the_screen_what_ellipses_would():
    """Radius, and the gradient of the centres, also with four channels, which are drawn in two passes."""
    means, scales, _, _, _ = world("spheres", 60, 0.4)
    colors = torch.rand(60, 4, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    found = []
    for backend in ("numba", "reference"):
        rgb, screen = render_gaussians(
            means.clone().requires_grad_(),
            scales,
            colors,
            turned_camera(),
            (0.0,),
            backend,
            outputs=("rgb", "screen"),
        )
        rgb.square().sum().backward()
        found.append(screen)
    assert torch.allclose(found[0].radius, found[1].radius, rtol=1e-5)
    assert found[0].visible.sum() > 10
    difference = (found[0].gradient - found[1].gradient).norm() / found[1].gradient.norm()
    assert float(difference) < 1e-3
    assert math.isfinite(float(difference))
