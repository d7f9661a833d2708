"""Targets, patches and marched pixels of training views."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from ihbench.fit.rays.marching import march_pixels, wanted_colors
from ihbench.fit.rays.ray_target import PosedBox, meets_box, ray_target
from ihbench.fit.rays.sampling import Pixels, draw_patches, draw_pixels
from ihbench.render.volumes.field import FieldValues
from ihbench.scene.contracts import MaskState
from tests.bench.fake_capture import a_camera, a_pose, the_body, train_view

BODY, SIZE = the_body(), 64


@pytest.fixture(scope="module")
def view():
    return train_view(a_camera(0.4, SIZE), a_pose(1.2, 0.3, (0.1, 0.0, 0.2)), slice(28, 35), frame=7)


class Slab:
    """Constant density and colour where the likelihood is 1: in a ball about the root."""

    def likelihood(self, rays, depths):
        return ((rays.points(depths) - self.middle(rays.origins)).norm(dim=-1) < 0.5).float()

    def middle(self, like):
        return torch.from_numpy(BODY.joints[0]).to(like)

    def values(self, points):
        inside = ((points - self.middle(points)).norm(dim=-1) < 0.5).float()
        return FieldValues(torch.full_like(points, 0.25), torch.full_like(points[:, 0], 3.0), inside)


def test_a_box_turns_with_the_person():
    """The same size however the root is turned and moved; the world's axes would give another."""
    boxes = [PosedBox.around(BODY, a_pose(yaw, 0.3, at)) for yaw, at in ((0.0, (0, 0, 0)), (0.8, (1.0, 2, 3)))]
    assert np.allclose(boxes[0].low, boxes[1].low)
    assert np.allclose(boxes[0].high, boxes[1].high)
    joints = BODY.posed_joints(a_pose(0.8, 0.3, (1.0, 2, 3)))
    R, t = boxes[1].frame
    own = joints @ R.T + t
    assert np.allclose(own.min(0) - 0.31, boxes[1].low)
    assert np.allclose(own[0], BODY.joints[0])


def test_the_box_holds_the_person(view):
    inside = meets_box(view.camera, PosedBox.around(BODY, view.body_pose))
    assert inside[view.mask == MaskState.PERSON].all()
    assert 0.2 < inside.mean() < 0.95


def test_what_a_hidden_pixel_is_taken_for(view):
    hidden = view.mask == MaskState.UNKNOWN
    assert hidden.any()
    released, ignoring = (ray_target(view, 0, BODY, unknown) for unknown in ("background", "ignore"))
    assert not released.unknown.any()
    assert np.array_equal(ignoring.unknown, hidden)
    assert hidden.ravel()[released.empty_pixels].any()
    assert not hidden.ravel()[ignoring.empty_pixels].any()
    assert not hidden.ravel()[ignoring.person_pixels].any()


def test_patches_lie_in_the_image_and_their_middles_where_they_should(view):
    target = ray_target(view, 0, BODY, "ignore")
    patches = draw_patches(target, 400, 8, np.random.default_rng(0))
    assert patches.rows.shape == patches.columns.shape == (400, 8, 8)
    for axis in (patches.rows, patches.columns):
        assert axis.min() >= 0
        assert axis.max() < SIZE
    assert (np.diff(patches.rows, axis=1) == 1).all()
    assert (np.diff(patches.columns, axis=2) == 1).all()
    middle = patches.rows[:, 4, 4], patches.columns[:, 4, 4]
    free = (middle[0] > 4) & (middle[0] < SIZE - 4) & (middle[1] > 4) & (middle[1] < SIZE - 4)
    on_person = target.person[middle][free]
    assert 0.72 < on_person.mean() < 0.88
    assert not target.unknown[middle][free].any()
    assert target.in_box[middle][free].all()


def test_small_images_and_views_without_anybody(view):
    target = ray_target(view, 0, BODY)
    whole = draw_patches(target, 2, 200, np.random.default_rng(0))
    assert whole.rows.shape == (2, SIZE, SIZE)
    nobody = ray_target(replace(view, mask=np.zeros_like(view.mask)), 0, BODY)
    assert not nobody.person[draw_patches(nobody, 5, 8, np.random.default_rng(0)).rows[:, 4, 4], 0].any()
    hidden = ray_target(replace(view, mask=np.full_like(view.mask, MaskState.UNKNOWN)), 0, BODY, "ignore")
    assert draw_patches(hidden, 5, 8, np.random.default_rng(0)).rows.shape == (5, 8, 8)
    assert draw_pixels(hidden, 5, np.random.default_rng(0)).rows.shape == (5,)


def test_single_pixels(view):
    target = ray_target(view, 0, BODY, "ignore")
    pixels = draw_pixels(target, 2000, np.random.default_rng(1), on_person=0.3)
    on_person = target.person[pixels.rows, pixels.columns]
    assert 0.26 < on_person.mean() < 0.34
    assert target.in_box[pixels.rows, pixels.columns][~on_person].all()
    assert not target.unknown[pixels.rows, pixels.columns].any()


def test_targets_are_composited_through_the_mask(view):
    target, background = ray_target(view, 0, BODY), torch.tensor([0.1, 0.6, 0.3])
    every = Pixels(*np.indices((SIZE, SIZE)))
    colors, unknown = wanted_colors(target, every, background)
    assert not unknown.any()
    person = torch.from_numpy(view.mask == MaskState.PERSON)
    assert torch.equal(colors[person], torch.from_numpy(view.image[person.numpy()].astype(np.float32) / 255))
    assert (colors[~person] == background).all()


@pytest.mark.parametrize("inside", [0, 48])
def test_pixels_through_a_ball(view, inside):
    """α = 1 - e^(-σℓ) through the middle of it, the background beside the box; as much with a second pass."""
    target, background = ray_target(view, 0, BODY), torch.tensor([1.0, 0.5, 0.0])
    every = Pixels(*np.indices((SIZE, SIZE)))
    shown = march_pixels(Slab(), target, every, 256, background, inside=inside)
    R, t = target.box.frame
    middle = view.camera.project((BODY.joints[0] - t) @ R)
    row, column = int(middle[1]), int(middle[0])
    alpha = 1 - math.exp(-3.0)
    assert shown.alpha[row, column].item() == pytest.approx(alpha, abs=5e-3)
    expected = alpha * 0.25 + (1 - alpha) * background
    assert torch.allclose(shown.rgb[row, column], expected, atol=5e-3)
    outside = torch.from_numpy(~target.in_box)
    assert (shown.rgb[outside] == background).all()
    assert (shown.alpha[outside] == 0).all()
    assert shown.depths.shape[1] == (inside or 256)
    again = march_pixels(Slab(), target, every, 256, background, np.random.default_rng(0), inside=inside)
    assert again.alpha[row, column].item() == pytest.approx(alpha, abs=2e-2)
    assert not torch.equal(again.depths, shown.depths)
