"""The float64 twin against arithmetic done by hand, loops, and finite differences."""

import math

import numpy as np
import pytest
import torch

from ihbench.render.splat import project_gaussians, render_gaussians
from ihbench.render.splat_reference import alphas_near_threshold, composite
from ihbench.render.splats import ALPHA_MAX, ALPHA_MIN, LOW_PASS, Splats
from tests.render.test_splat import front_camera, random_gaussians


def splats_from(xy, variance, depth, colors):
    as64 = [torch.tensor(a, dtype=torch.float64) for a in (xy, variance, colors)]
    return Splats(as64[0], as64[1], torch.tensor(depth, dtype=torch.float32), as64[2])


def test_against_a_loop_over_pixels():
    rng = np.random.default_rng(0)
    n, height, width = 40, 9, 21
    xy, variance = rng.uniform(-3, 24, (n, 2)), rng.uniform(0.3, 20, n)
    depth, colors, bg = rng.integers(1, 6, n), rng.uniform(size=(n, 3)), rng.uniform(size=3)
    rgb, alpha = composite(splats_from(xy, variance, depth, colors), height, width, torch.tensor(bg), block=4)
    order = sorted(range(n), key=lambda i: (depth[i], i))
    for row in range(height):
        for col in range(width):
            left, color = 1.0, np.zeros(3)
            for i in order:
                squared = (col + 0.5 - xy[i, 0]) ** 2 + (row + 0.5 - xy[i, 1]) ** 2
                a = min(math.exp(-squared / (2 * variance[i])), ALPHA_MAX)
                if a >= ALPHA_MIN:
                    color += left * a * colors[i]
                    left *= 1 - a
            assert rgb[row, col].numpy() == pytest.approx(color + left * bg, abs=1e-12)
            assert float(alpha[row, col]) == pytest.approx(1 - left, abs=1e-12)


@pytest.mark.parametrize("block", [1, 5, 16, 1000])
def test_the_blocks_change_nothing(block):
    splats = project_gaussians(*random_gaussians(100, dtype=torch.float64), front_camera())
    whole, _ = composite(splats, 28, 40, torch.ones(3), block=40)
    parts, _ = composite(splats, 28, 40, torch.ones(3), block=block)
    assert torch.allclose(whole, parts, rtol=0, atol=1e-13)


def test_gradcheck():
    """Finite differences, where no alpha lies near a threshold."""
    means, scales, colors = random_gaussians(6, seed=3, dtype=torch.float64)
    camera = front_camera(9, 7, focal=9.0)
    weight = torch.from_numpy(np.random.default_rng(0).normal(size=(7, 9, 4)))
    near = alphas_near_threshold(project_gaussians(means, scales, colors, camera), 7, 9, tolerance=1e-3)
    weight[near > 0] = 0
    assert (near == 0).double().mean() > 0.7

    def draw(*inputs):
        rgb, alpha = render_gaussians(*inputs, camera, (0.3, 0.1, 0.8), "reference")
        return (weight * torch.cat([rgb, alpha[..., None]], -1)).sum()

    assert torch.autograd.gradcheck(draw, [x.requires_grad_() for x in (means, scales, colors)], eps=1e-6, atol=1e-6)


def test_gradient_of_one_splat_by_hand():
    """alpha = exp(-d²/2v): d alpha/d x = alpha (px - x)/v, d alpha/d v = alpha d²/2v², d rgb/d color = alpha."""
    xy = torch.tensor([[5.2, 3.9]], dtype=torch.float64, requires_grad=True)
    variance = torch.tensor([2.0], dtype=torch.float64, requires_grad=True)
    colors = torch.tensor([[0.3]], dtype=torch.float64, requires_grad=True)
    bg = torch.tensor([0.8], dtype=torch.float64)
    rgb, alpha = composite(Splats(xy, variance, torch.ones(1), colors), 8, 12, bg)
    for row, col in ((4, 6), (3, 3), (1, 5)):
        dx, dy = col + 0.5 - 5.2, row + 0.5 - 3.9
        a = math.exp(-(dx * dx + dy * dy) / 4)
        gx, gv = torch.autograd.grad(alpha[row, col], [xy, variance], retain_graph=True)
        assert gx[0].tolist() == pytest.approx([a * dx / 2, a * dy / 2], rel=1e-12)
        assert float(gv) == pytest.approx(a * (dx * dx + dy * dy) / 8, rel=1e-12)
        gx, gc = torch.autograd.grad(rgb[row, col, 0], [xy, colors], retain_graph=True)
        assert gx[0, 0].item() == pytest.approx(a * dx / 2 * (0.3 - 0.8), rel=1e-12)
        assert float(gc) == pytest.approx(a, rel=1e-12)


def test_no_gradient_where_alpha_is_cut_off():
    xy = torch.tensor([[4.51, 4.5]], dtype=torch.float64, requires_grad=True)
    _, alpha = composite(Splats(xy, torch.tensor([0.9]), torch.ones(1), torch.ones(1, 1)), 9, 9, torch.ones(1))
    assert float(alpha[4, 4].detach()) == pytest.approx(ALPHA_MAX)
    assert (torch.autograd.grad(alpha[4, 4], xy)[0] == 0).all()


def test_a_splat_smaller_than_a_pixel_is_still_seen():
    """Between four pixel centres the low-pass leaves exp(-0.25/0.3) at each."""
    _, alpha = composite(splats_from([[4.0, 4.0]], [LOW_PASS], [1], [[0.0]]), 8, 8, torch.ones(1))
    assert alpha[3:5, 3:5].flatten().tolist() == pytest.approx([math.exp(-0.25 / LOW_PASS)] * 4)


def test_threshold_counts():
    """A footprint that has the threshold, or nearly, three pixels from its centre is counted there and not at it."""
    for threshold in (ALPHA_MIN, ALPHA_MAX):
        for excess, seen in ((0.0, True), (5e-5, True), (-5e-5, True), (1.5e-4, False), (-1.5e-4, False)):
            v = 3.0**2 / (-2 * math.log(threshold * (1 + excess)))  # reached 3 px from the centre
            splats = splats_from([[6.5, 4.5]] * 2, [v, 1.0], [1, 2], [[0.0]] * 2)
            count = alphas_near_threshold(splats, 9, 12, tolerance=1e-4)
            assert count[4, 9] == seen
            assert count[4, 3] == seen
            assert count[4, 6] == 0
