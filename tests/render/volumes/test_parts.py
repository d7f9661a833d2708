"""Rays, intervals, density laws and compositing, each against its formula."""

import math

import numpy as np
import pytest
import torch

from ihbench.camera import Camera, look_at
from ihbench.render.volumes.compositing import alpha_composite, ray_weights, scattered_composite
from ihbench.render.volumes.density_laws import laplace_density, opacity, relu_density, softplus_density
from ihbench.render.volumes.intervals import active_interval, box_interval, even_depths, segment_lengths
from ihbench.render.volumes.rays import Rays, pixel_rays


def a_camera(distortion=None):
    R, t = look_at(np.array([0.3, 0.4, 3.0]), np.zeros(3))
    return Camera(np.array([[90.0, 2.0, 30.5], [0, 95.0, 33.0], [0, 0, 1]]), R, t, 64, 64, distortion)


def test_points_of_a_ray_project_to_the_centre_of_its_pixel_at_its_depth():
    camera, rows, columns = a_camera(), np.array([0, 10, 63]), np.array([5, 40, 0])
    rays = pixel_rays(camera, rows, columns, dtype=torch.float64)
    depths = torch.tensor([[1.0, 2.5]] * 3, dtype=torch.float64)
    seen = camera.project(rays.points(depths).numpy())
    assert np.allclose(seen[..., 0], columns[:, None] + 0.5)
    assert np.allclose(seen[..., 1], rows[:, None] + 0.5)
    assert np.allclose(seen[..., 2], depths)


def test_rays_in_another_frame_are_the_same_points():
    camera, rows, columns = a_camera(), np.array([3, 20]), np.array([50, 7])
    R, t = look_at(np.array([0.1, -2, 1.0]), np.zeros(3))
    world, own = (pixel_rays(camera, rows, columns, frame, torch.float64) for frame in (None, (R, t)))
    depths = torch.full((2, 1), 2.0, dtype=torch.float64)
    assert np.allclose(own.points(depths).numpy(), world.points(depths).numpy() @ R.T + t)


def test_a_camera_with_lens_distortion_is_refused():
    with pytest.raises(ValueError, match="no lens distortion"):
        pixel_rays(a_camera(np.array([0.1, 0, 0, 0, 0])), np.zeros(1, int), np.zeros(1, int))


def test_box_interval():
    """Through the middle, beside it, from within, away from it, and along a face."""
    origins = torch.tensor([[0, 0, -3.0], [2, 0, -3.0], [0, 0, 0], [0, 0, 3.0], [0, 0.5, -3.0]])
    rays = Rays(origins, torch.tensor([[0, 0, 1.0]]).repeat(5, 1))
    near, far = box_interval(rays, -torch.ones(3), torch.ones(3))
    assert near[0] == 2
    assert far[0] == 4
    assert (near < far).tolist() == [True, False, True, False, True]
    assert near[2] == 0
    assert far[2] == 1
    near, far = box_interval(rays, torch.tensor([-1, 0.5, -1]), torch.ones(3))
    assert near[4] < far[4]


def test_even_depths_hold_both_ends_and_stratified_ones_their_strata():
    near, far = torch.tensor([1.0, 2.0]), torch.tensor([2.0, 6.0])
    depths = even_depths(near, far, 5)
    assert torch.allclose(depths[1], torch.tensor([2.0, 3, 4, 5, 6]))
    low, high = (even_depths(near, far, 5, torch.full((2, 5), share)) for share in (0.0, 1.0))
    assert torch.allclose(low[1], torch.tensor([2, 2.5, 3.5, 4.5, 5.5]))
    assert torch.allclose(high[1], torch.tensor([2.5, 3.5, 4.5, 5.5, 6]))


def test_segment_lengths_are_metres_along_the_ray():
    depths = torch.tensor([[1.0, 2.0, 4.0]])
    assert segment_lengths(depths, torch.tensor([1.5])).tolist() == [[1.5, 3.0, 3.0]]
    assert segment_lengths(depths, torch.tensor([1.5]), last=1e10).tolist() == [[1.5, 3.0, 1e10]]


def test_active_interval_reaches_one_lattice_point_beyond():
    depths = torch.arange(6.0).repeat(3, 1)
    active = torch.zeros(3, 6, dtype=torch.bool)
    active[0, 2:4] = True
    active[1, 0] = True
    near, far = active_interval(depths, active)
    assert near.tolist() == [1, 0, 0]
    assert far.tolist() == [4, 1, 0]


def test_density_laws():
    raw = torch.tensor([-2.0, 0.0, 3.0], dtype=torch.float64)
    assert relu_density(raw).tolist() == [0, 0, 3]
    assert softplus_density(raw)[1].item() == pytest.approx(math.log(2))
    beta = 0.1
    distance = torch.tensor([-50.0, -0.1, 0.0, 0.1, 50.0], dtype=torch.float64, requires_grad=True)
    density = laplace_density(distance, beta)
    half = 0.5 * math.exp(-1)
    assert density.tolist() == pytest.approx([10, 10 * (1 - half), 5, 10 * half, 0])
    density.sum().backward()
    assert distance.grad is not None
    assert distance.grad.isfinite().all()
    assert distance.grad[2].item() == pytest.approx(-0.5 / beta**2)  # the density is smooth on the surface


def test_constant_density_over_a_length():
    """α = 1 - e^(-σℓ), colour α c + (1 - α) background: changing the background changes it by (1 - α) of that."""
    lengths = torch.full((1, 50), 0.02, dtype=torch.float64)
    alpha = opacity(torch.full_like(lengths, 1.7), lengths)
    color = torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64).expand(1, 50, 3)
    shown = alpha_composite(alpha, color, lengths.cumsum(1))
    expected = 1 - math.exp(-1.7)
    assert shown.alpha.item() == pytest.approx(expected, abs=1e-8)
    assert torch.allclose(shown.rgb, expected * color[:, 0], atol=1e-8)
    white, black = (shown.on(torch.full((3,), c, dtype=torch.float64)) for c in (1.0, 0.0))
    assert (white - black).tolist()[0] == pytest.approx([math.exp(-1.7)] * 3, abs=1e-8)
    assert opacity(torch.tensor(1e-9), torch.tensor(1e-3)).item() == pytest.approx(1e-12, rel=1e-5)


def test_weights_go_on_behind_what_is_in_front():
    """Compositing in two blocks is compositing in one."""
    alpha = torch.rand(4, 10, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    whole, left = ray_weights(alpha)
    front, through = ray_weights(alpha[:, :4])
    behind, rest = ray_weights(alpha[:, 4:], through)
    assert torch.allclose(torch.cat([front, behind], 1), whole)
    assert torch.allclose(rest, left)
    assert torch.allclose(whole.sum(1) + left, torch.ones(4, dtype=torch.float64), atol=1e-8)


def test_scattered_samples_composite_as_dense_ones_forward_and_back():
    generator = torch.Generator().manual_seed(1)
    active = torch.rand(6, 9, generator=generator) > 0.6
    count = int(active.sum())
    alpha, colors = (
        torch.rand(count, *shape, generator=generator, dtype=torch.float64).requires_grad_() for shape in ((), (3,))
    )
    depths = torch.rand(6, 9, generator=generator, dtype=torch.float64).cumsum(1)
    gradients = []
    for scattered in (True, False):
        dense = torch.zeros(6, 9, dtype=torch.float64).masked_scatter(active, alpha)
        if scattered:
            shown = scattered_composite(dense, colors, depths, active)
        else:
            every = torch.zeros(6, 9, 3, dtype=torch.float64).masked_scatter(
                active[..., None].expand(6, 9, 3), colors
            )
            shown = alpha_composite(dense, every, depths)
        loss = shown.rgb.sin().sum() + shown.alpha.square().sum() + shown.depth.sum()
        gradients.append((loss.detach(), *torch.autograd.grad(loss, (alpha, colors))))
    for one, other in zip(*gradients, strict=True):
        assert torch.allclose(one, other)
