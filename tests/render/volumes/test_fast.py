"""The renderer that skips against the float64 twin that does not, on a field in closed form."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from ihbench.camera import Camera, look_at
from ihbench.render.volumes.fast import Skipping, box_rays, draw_image, draw_rays, march
from ihbench.render.volumes.field import FieldValues
from ihbench.render.volumes.intervals import even_depths, segment_lengths
from ihbench.render.volumes.rays import Rays
from ihbench.render.volumes.reference import reference_rays

SAMPLES = 64
BOX = torch.tensor([[-1.0, -1, -1], [1, 1, 1]])


@dataclass
class Ball:
    """A soft coloured ball whose likelihood falls with the distance from its middle, and how often it was asked."""

    strength: torch.Tensor
    asked: int = 0

    def likelihood(self, rays, depths):
        return self._likelihood(rays.points(depths)).detach()

    def _likelihood(self, points):
        return torch.exp(-points.square().sum(-1) / 0.08)

    def values(self, points):
        self.asked += len(points)
        rgb = 0.5 + 0.5 * torch.sin(4 * points * self.strength)
        density = 20 * self.strength * (1 + points[:, 0].sin()) ** 2
        return FieldValues(rgb, density, self._likelihood(points))


def a_camera(size=40):
    R, t = look_at(np.array([0.2, 0.3, 2.5]), np.zeros(3))
    return Camera(np.array([[1.2 * size, 0, size / 2], [0, 1.2 * size, size / 2], [0, 0, 1]]), R, t, size, size)


def some_rays(every=7):
    parts = list(box_rays(a_camera(), (BOX[0], BOX[1])))
    _, rays, near, far = parts[0]
    assert len(parts) == 1
    depths = even_depths(near[::every], far[::every], SAMPLES)
    rays = rays[slice(None, None, every)]
    return rays, depths, segment_lengths(depths, rays.lengths)


def exact(rays, depths, lengths, strength=1.0):
    own = Rays(rays.origins.double(), rays.directions.double())
    return reference_rays(Ball(torch.tensor(strength).double()), own, depths.double(), lengths.double())


@pytest.mark.parametrize("least", [0.0, 1e-3, 1e-2])
def test_marched_rays_are_the_twins_but_for_the_likelihoods_left_out(least):
    rays, depths, lengths = some_rays()
    field = Ball(torch.tensor(1.0))
    marched = march(field, rays, depths, lengths, least)
    every = field.likelihood(rays, depths)
    left_out = torch.where(every > least, 0.0, every).sum(1)
    assert left_out.max() > (0.01 if least == 1e-2 else -1)  # else this shows nothing
    rgb, alpha, depth = exact(rays, depths, lengths)
    composited = marched.composited
    assert ((composited.rgb - rgb).abs().amax(1) <= left_out + 2e-5).all()
    assert ((composited.alpha - alpha).abs() <= left_out + 2e-5).all()
    assert ((composited.depth - depth).abs() <= 4 * left_out + 1e-4).all()
    assert field.asked == int(marched.active.sum()) == len(marched.values.rgb)


def test_gradients_are_the_twins():
    rays, depths, lengths = some_rays(every=31)
    strengths = [torch.tensor(1.0, requires_grad=True), torch.tensor(1.0, dtype=torch.float64, requires_grad=True)]
    pull = torch.rand(len(rays), 3, generator=torch.Generator().manual_seed(2))
    shown = march(Ball(strengths[0]), rays, depths, lengths, 0.0).composited
    ((shown.rgb * pull).sum() + shown.alpha.sum() + shown.depth.sum()).backward()
    own = Rays(rays.origins.double(), rays.directions.double())
    rgb, alpha, depth = reference_rays(Ball(strengths[1]), own, depths.double(), lengths.double())
    ((rgb * pull).sum() + alpha.sum() + depth.sum()).backward()
    assert strengths[0].grad.item() == pytest.approx(strengths[1].grad.item(), rel=1e-4)


@pytest.mark.parametrize("block", [1, 7, 16, SAMPLES])
def test_an_early_stop_costs_no_more_than_what_was_let_through(block):
    rays, depths, lengths = some_rays()
    field = Ball(torch.tensor(1.0))
    rgb, alpha, _ = exact(rays, depths, lengths)
    for stop in (0.0, 1e-3, 0.1):
        drawn, total, _ = draw_rays(field, rays, depths, lengths, Skipping(0.0, stop, block))
        assert (drawn - rgb).abs().max() <= stop + 2e-5
        assert (total - alpha).abs().max() <= stop + 2e-5
    asked = []
    for stop in (0.0, 0.1):
        field.asked = 0
        draw_rays(field, rays, depths, lengths, Skipping(1e-3, stop, block))
        asked.append(field.asked)
    assert asked[1] < asked[0] or block == SAMPLES


def test_a_picture_is_its_rays_and_the_background_beside_them():
    camera, background = a_camera(24), (0.2, 0.4, 0.6)
    field = Ball(torch.tensor(1.0))
    whole = draw_image(field, camera, (BOX[0], BOX[1]), SAMPLES, background)
    parts = draw_image(field, camera, (BOX[0], BOX[1]), SAMPLES, background, skipping=Skipping(portion=50))
    assert torch.allclose(whole.rgb, parts.rgb, atol=1e-6)
    assert whole.rgb.shape == (24, 24, 3)
    assert whole.alpha.max() > 0.95
    alone = draw_image(field, camera, (BOX[0], BOX[1]), SAMPLES, (0.0, 0.0, 0.0))
    expected = alone.rgb + (1 - alone.alpha[..., None]) * torch.tensor(background)
    assert torch.allclose(whole.rgb, expected, atol=1e-6)
    corner = whole.rgb[0, 0] - torch.tensor(background)
    assert corner.abs().max() < 1e-6
    seen = whole.alpha > 0.9
    assert (whole.depth[seen] / whole.alpha[seen]).min() > 1.9  # nobody stands nearer than the ball
    assert (whole.depth[seen] / whole.alpha[seen]).max() < 2.8


def test_nothing_to_draw():
    R, t = look_at(np.array([0.0, 0.0, 2.5]), np.array([0.0, 0.0, 5.0]))
    away = Camera(a_camera(8).K, R, t, 8, 8)
    drawn = draw_image(Ball(torch.tensor(1.0)), away, (BOX[0], BOX[1]), 8, (1.0, 0.0, 0.0))
    assert (drawn.alpha == 0).all()
    assert (drawn.rgb == torch.tensor([1.0, 0, 0])).all()
