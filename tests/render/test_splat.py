"""What `render_gaussians` promises whatever the back end is: laws, extremes, bad input."""

import math

import numpy as np
import pytest
import torch

from ihbench.camera import Camera
from ihbench.render.splat import render_gaussians
from ihbench.render.splats import ALPHA_MAX, ALPHA_MIN, LOW_PASS, NEAR

CPU_BACKENDS = ("reference", "numba")
both = pytest.mark.parametrize("backend", CPU_BACKENDS)


def front_camera(width=40, height=28, focal=40.0, shift=(0.0, 0.0)):
    K = np.array([[focal, 0, width / 2 + shift[0]], [0, focal, height / 2 + shift[1]], [0, 0, 1.0]])
    return Camera(K, np.eye(3), np.zeros(3), width, height)


def random_gaussians(n, seed=0, dtype=torch.float32):
    g = torch.Generator().manual_seed(seed)
    means = (torch.rand(n, 3, generator=g, dtype=torch.float64) - 0.5) * torch.tensor([2.2, 1.6, 1.0])
    means[:, 2] += 2.0
    scales = 0.02 + 0.08 * torch.rand(n, generator=g, dtype=torch.float64)
    colors = torch.rand(n, 3, generator=g, dtype=torch.float64)
    return means.to(dtype), scales.to(dtype), colors.to(dtype)


@both
def test_one_gaussian_is_the_formula(backend):
    camera = front_camera()
    mean = torch.tensor([[0.11, -0.07, 2.0]], dtype=torch.float64)
    color = torch.tensor([[0.2, 0.5, 0.9]], dtype=torch.float64)
    rgb, alpha = render_gaussians(mean, torch.tensor([0.1], dtype=torch.float64), color, camera, backend=backend)
    u, v = 40 * 0.11 / 2 + 20, 40 * -0.07 / 2 + 14
    variance = (40 * 0.1 / 2) ** 2 + LOW_PASS
    y, x = np.mgrid[:28, :40] + 0.5
    expected = np.minimum(np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * variance)), ALPHA_MAX)
    expected[expected < ALPHA_MIN] = 0
    assert np.abs(alpha.numpy() - expected).max() < 1e-5
    picture = expected[..., None] * color.numpy() + 1 - expected[..., None]
    assert np.abs(rgb.numpy() - picture).max() < 1e-5


@both
def test_the_pixels_are_the_cameras(backend):
    """A tiny splat is brightest at the pixel into which the camera projects its centre: rotated, skewed, fx != fy."""
    c, s = math.cos(0.4), math.sin(0.4)
    K = np.array([[50.0, 3.0, 21.0], [0, 35.0, 12.0], [0, 0, 1]])
    camera = Camera(K, np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]), np.array([0.1, -0.2, 0.3]), 40, 28)
    for point in ([0.9, 0.4, 2.0], [0.8, 0.1, 3.0], [1.2, -0.3, 2.5]):
        x, y, _ = camera.project(np.array(point))
        assert 0 < x < 40
        assert 0 < y < 28
        _, alpha = render_gaussians(
            torch.tensor([point]), torch.tensor([1e-4]), torch.ones(1, 3), camera, backend=backend
        )
        row, col = divmod(int(alpha.argmax()), 40)
        assert (row, col) == (math.floor(y), math.floor(x))


@both
def test_order_of_the_input_does_not_matter(backend):
    means, scales, colors = random_gaussians(200)
    shuffle = torch.randperm(200, generator=torch.Generator().manual_seed(1))
    first = render_gaussians(means, scales, colors, front_camera(), backend=backend)
    second = render_gaussians(means[shuffle], scales[shuffle], colors[shuffle], front_camera(), backend=backend)
    assert torch.equal(first[0], second[0])
    assert torch.equal(first[1], second[1])


@both
def test_equal_depths_keep_the_order_of_their_index(backend):
    means = torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, 2.0]])
    scales, red_then_blue = torch.tensor([0.3, 0.3]), torch.tensor([[1.0, 0, 0], [0, 0, 1.0]])
    rgb, _ = render_gaussians(means, scales, red_then_blue, front_camera(), backend=backend)
    swapped, _ = render_gaussians(means, scales, red_then_blue.flip(0), front_camera(), backend=backend)
    assert rgb[14, 20, 0] > 0.99
    assert swapped[14, 20, 2] > 0.99


@both
def test_near_hides_far(backend):
    means = torch.tensor([[0.0, 0.0, 3.0], [0.0, 0.0, 2.0]])
    scales, colors = torch.tensor([0.6, 0.4]), torch.tensor([[1.0, 0, 0], [0, 1.0, 0]])
    rgb, _ = render_gaussians(means, scales, colors, front_camera(width=41, height=29), backend=backend)
    assert torch.allclose(rgb[14, 20], torch.tensor([1 - ALPHA_MAX, ALPHA_MAX, 0.0]), atol=2e-5)


@both
def test_colour_is_linear(backend):
    means, scales, colors = random_gaussians(150)
    other = random_gaussians(150, seed=5)[2]

    def draw(c):
        return render_gaussians(means, scales, c, front_camera(), (0.0, 0.0, 0.0), backend)[0]

    assert torch.allclose(draw(0.3 * colors + 2 * other), 0.3 * draw(colors) + 2 * draw(other), atol=1e-5)


@both
def test_background_shows_what_alpha_leaves(backend):
    means, scales, colors = random_gaussians(60)
    black, alpha = render_gaussians(means, scales, colors, front_camera(), (0.0, 0.0, 0.0), backend)
    bg = torch.tensor([0.2, 0.7, 0.4])
    rgb, same_alpha = render_gaussians(means, scales, colors, front_camera(), bg, backend)
    assert torch.equal(alpha, same_alpha)
    assert torch.allclose(rgb, black + (1 - alpha)[..., None] * bg, atol=1e-6)
    # and alpha is what a white splat leaves on black
    white, _ = render_gaussians(means, scales, torch.ones_like(colors), front_camera(), (0.0, 0.0, 0.0), backend)
    assert torch.allclose(white, alpha[..., None].expand(-1, -1, 3), atol=1e-5)


@both
@pytest.mark.parametrize("step", [(1, 0), (0, -3), (17, 9)])
def test_moving_the_principal_point_moves_the_image(backend, step):
    """By whole pixels and across tile borders: the image is the same one, elsewhere."""
    means, scales, colors = random_gaussians(80, dtype=torch.float64)
    means[:, :2] *= 0.3
    still, _ = render_gaussians(means, scales, colors, front_camera(70, 60), backend=backend)
    moved, _ = render_gaussians(means, scales, colors, front_camera(70, 60, shift=step), backend=backend)
    assert torch.allclose(torch.roll(still, (step[1], step[0]), (0, 1)), moved, atol=1e-5)
    assert (still < 0.5).any()


@both
def test_cropping_the_camera_crops_the_image(backend):
    means, scales, colors = random_gaussians(120)
    camera = front_camera(50, 37)
    whole, _ = render_gaussians(means, scales, colors, camera, backend=backend)
    part, _ = render_gaussians(means, scales, colors, camera.cropped(7, 5, 21, 18), backend=backend)
    assert torch.allclose(part, whole[5:23, 7:28], atol=2e-5)


@both
@pytest.mark.parametrize("channels", [1, 2, 3, 4, 7])
def test_any_number_of_channels(backend, channels):
    means, scales, _ = random_gaussians(50)
    colors = torch.rand(50, channels, generator=torch.Generator().manual_seed(2), requires_grad=True)
    bg = torch.linspace(0, 1, channels)
    rgb, _ = render_gaussians(means, scales, colors, front_camera(), bg, backend)
    assert rgb.shape == (28, 40, channels)
    for c in range(channels):
        one, _ = render_gaussians(means, scales, colors[:, c : c + 1], front_camera(), bg[c : c + 1], backend)
        assert torch.allclose(rgb[..., c], one[..., 0], atol=1e-6)
    (gradient,) = torch.autograd.grad(rgb.square().sum(), colors)
    (expected,) = torch.autograd.grad(
        render_gaussians(means, scales, colors, front_camera(), bg, "reference")[0].square().sum(), colors
    )
    assert torch.allclose(gradient, expected, atol=1e-3)


@both
@pytest.mark.parametrize("n", [0, 3])
def test_nothing_in_view_is_the_background(backend, n):
    """No Gaussians, or all of them behind the camera, at the near plane or far outside the image."""
    means = torch.tensor([[0.0, 0.0, -2.0], [0.0, 0.0, NEAR], [1e3, 0.0, 2.0]])[:n].requires_grad_()
    scales, colors = torch.full((n,), 0.1, requires_grad=True), torch.zeros(n, 3, requires_grad=True)
    rgb, alpha = render_gaussians(means, scales, colors, front_camera(), (0.1, 0.2, 0.3), backend)
    assert torch.allclose(rgb, torch.tensor([0.1, 0.2, 0.3]).expand(28, 40, 3))
    assert (alpha == 0).all()
    rgb.sum().backward()
    for x in (means, scales, colors):
        assert x.grad is not None
        assert (x.grad == 0).all()


@both
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e38])
@pytest.mark.parametrize("where", ["mean", "scale", "color"])
def test_a_broken_gaussian_is_left_out_and_gets_no_gradient(backend, bad, where):
    if where == "color" and bad == 1e38:
        bad = math.nan  # a huge colour is a colour
    good = random_gaussians(30)
    means, scales, colors = (x.clone() for x in good)
    keep = torch.arange(30) != 11
    {"mean": means[11], "scale": scales[11:12], "color": colors[11]}[where][0] = bad
    leaves = [x.requires_grad_() for x in (means, scales, colors)]
    rgb, alpha = render_gaussians(*leaves, front_camera(), backend=backend)
    expected, _ = render_gaussians(*(x[keep] for x in good), front_camera(), backend=backend)
    assert torch.equal(rgb, expected)
    (rgb.sum() + alpha.sum()).backward()
    for x in leaves:
        assert x.grad is not None
        assert x.grad.isfinite().all()
        assert (x.grad[11] == 0).all()
        assert (x.grad[keep] != 0).any()


@both
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_result_has_the_dtype_of_the_means(backend, dtype):
    inputs = [x.requires_grad_() for x in random_gaussians(20, dtype=dtype)]
    rgb, alpha = render_gaussians(*inputs, front_camera(), backend=backend)
    assert rgb.dtype == alpha.dtype == dtype
    rgb.sum().backward()
    assert all(x.grad.dtype == dtype for x in inputs)


@both
def test_no_grad_keeps_nothing(backend):
    inputs = [x.requires_grad_() for x in random_gaussians(40)]
    with torch.no_grad():
        rgb, alpha = render_gaussians(*inputs, front_camera(), backend=backend)
    assert rgb.grad_fn is None
    assert alpha.grad_fn is None
    assert torch.allclose(rgb, render_gaussians(*inputs, front_camera(), backend=backend)[0])


def test_auto_takes_numba_on_the_cpu():
    inputs = random_gaussians(100)
    auto, _ = render_gaussians(*inputs, front_camera())
    assert torch.equal(auto, render_gaussians(*inputs, front_camera(), backend="numba")[0])


def test_auto_falls_back_to_the_reference(monkeypatch):
    monkeypatch.setattr("ihbench.render.splat.find_spec", lambda name: None)
    inputs = random_gaussians(20)
    auto, _ = render_gaussians(*inputs, front_camera())
    assert torch.equal(auto, render_gaussians(*inputs, front_camera(), backend="reference")[0])
    with pytest.raises(ImportError, match="numba is not installed"):
        render_gaussians(*inputs, front_camera(), backend="numba")


def test_bad_input_is_named():
    means, scales, colors = random_gaussians(4)
    camera = front_camera()
    with pytest.raises(ValueError, match="back end 'numbra': expected one of auto, reference, numba, gsplat"):
        render_gaussians(means, scales, colors, camera, backend="numbra")
    distorted = Camera(camera.K, camera.R, camera.t, 40, 28, np.array([0.1, 0, 0, 0, 0]))
    with pytest.raises(ValueError, match="no lens distortion"):
        render_gaussians(means, scales, colors, distorted)
    with pytest.raises(ValueError, match=r"scales \[N\]"):
        render_gaussians(means, scales[:, None], colors, camera)
    with pytest.raises(ValueError, match=r"expected means \[N, 3\]"):
        render_gaussians(means[:3], scales, colors, camera)
    with pytest.raises(ValueError, match="1 or 3 values, got 2"):
        render_gaussians(means, scales, colors, camera, (1.0, 1.0))
    for wrong, word in (
        ((means.numpy(), scales, colors, camera), "means: expected a tensor of floats, got ndarray"),
        ((means, scales, (colors * 255).byte(), camera), "colors: expected a tensor of floats, got torch.uint8"),
        ((means, scales.log(), colors, camera), r"exp\(\)"),
        ((means, scales, colors * 255, camera), "divide by 255"),
        ((means, scales[:, None].expand(-1, 3), colors, camera), "one scale each"),
        ((means.T, scales, colors, camera), "transpose"),
        ((means, scales, colors, camera.K), "Camera"),
        ((means, scales, colors, camera, (255, 255, 255)), "background.*divide by 255"),
        ((means, scales, colors, camera, "white"), "background.*numbers"),
        ((means[0, 0], scales, colors, camera), "expected means"),
    ):
        with pytest.raises(ValueError, match=word):
            render_gaussians(*wrong)
    render_gaussians(means, scales, colors.repeat(1, 2) * 255, camera, (0.0,))  # features may have any size
