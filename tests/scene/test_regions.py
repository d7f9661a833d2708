"""Regions of a test view: a partition of the true silhouette by what training showed."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from ihbench.body import texel_table
from ihbench.camera import look_at
from ihbench.scene.protocol import REGIONS
from ihbench.scene.regions import SurfaceMap, projected_box
from ihbench.scene.visibility import Visibility, texel_visibility
from tests.bench.fake_capture import SIZE, a_camera, a_pose, rasterized, the_body, train_view, truth_view

BODY = the_body()
TEXELS = texel_table(BODY, 128)
PADDING = 0.05  # m
CENTRE = slice(SIZE // 2 - 4, SIZE // 2 + 4)


def surface_map(views):
    return SurfaceMap.build(BODY, TEXELS, texel_visibility(views, BODY, TEXELS))


@pytest.fixture(scope="module")
def half_hidden():
    """Trained on the front and the left side, the middle of both behind a strip."""
    return surface_map([train_view(a_camera(), a_pose(heading), CENTRE) for heading in (0.0, -0.8)])


@pytest.mark.parametrize("azimuth", [0.0, 1.0, 2.5, 4.2])
def test_the_three_partition_the_body_and_the_body_is_the_truth(half_hidden, azimuth):
    view = truth_view(a_camera(azimuth, 128), a_pose(0.2, 0.4))
    found = half_hidden.regions(view, REGIONS, PADDING)
    assert list(found) == list(REGIONS)
    assert all(mask.shape == (128, 128) and mask.dtype == bool for mask in found.values())
    assert np.array_equal(found["body"], view.silhouette)
    parts = np.stack([found[name] for name in ("visible", "hidden", "never_seen")])
    assert np.array_equal(parts.sum(0), found["body"].astype(int))
    assert found["full"].all()
    assert found["box"][found["body"]].all()
    assert 0.05 < found["box"].mean() < 0.8


def test_only_what_is_asked_for(half_hidden):
    view = truth_view(a_camera(), a_pose())
    assert list(half_hidden.regions(view, ("body", "hidden"), PADDING)) == ["body", "hidden"]


def test_behind_somebody_seen_from_the_front():
    front = surface_map([train_view(a_camera(), a_pose())])
    same = front.regions(truth_view(a_camera(0.0), a_pose()), REGIONS, PADDING)
    behind = front.regions(truth_view(a_camera(np.pi), a_pose()), REGIONS, PADDING)
    assert same["visible"].sum() > 0.95 * same["body"].sum()
    assert behind["never_seen"].sum() > 0.9 * behind["body"].sum()
    assert not same["hidden"].any()
    assert not behind["hidden"].any()


def test_the_strip_comes_back_as_the_hidden_region():
    """The test view of the training camera: hidden is the strip, to a pixel."""
    view = train_view(a_camera(), a_pose(), CENTRE)
    found = surface_map([view]).regions(truth_view(a_camera(), a_pose()), REGIONS, PADDING)
    columns = np.arange(SIZE)
    sure = (columns >= CENTRE.start + 1) & (columns < CENTRE.stop - 1)
    assert found["hidden"][:, sure].sum() > 0.9 * found["body"][:, sure].sum()
    assert not found["hidden"][:, (columns < CENTRE.start - 1) | (columns > CENTRE.stop)].any()


@pytest.mark.parametrize("azimuth", [0.0, 2.0])
def test_labels_land_on_their_part_of_the_body(azimuth):
    """Texels above the chest are marked hidden: the region must be where the drawn body is above the chest. Any
    flip or transposition of UV space puts it elsewhere."""
    height = TEXELS.interpolate(BODY.v_template, BODY.faces)[:, 1]
    marked = height > 0.25
    one = np.ones(len(marked), np.int32)
    labels = SurfaceMap.build(BODY, TEXELS, Visibility(faced=one, seen=np.where(marked, 0, one)))
    view = truth_view(a_camera(azimuth, 160), a_pose(0.3))
    raster = rasterized(view.camera, view.body_pose)
    expected = raster.interpolate(BODY.v_template, BODY.faces)[..., 1] > 0.25
    got = labels.regions(view, REGIONS, PADDING)
    assert (got["hidden"] == (expected & raster.mask))[raster.mask].mean() > 0.99
    assert not got["never_seen"].any()


def test_a_garments_rim_takes_the_label_of_the_nearest_body_pixel(half_hidden):
    view = truth_view(a_camera(0.5), a_pose())
    body = rasterized(view.camera, view.body_pose).mask
    bare = half_hidden.regions(view, REGIONS, PADDING)
    wide = half_hidden.regions(replace(view, silhouette=np.ones_like(body)), REGIONS, PADDING)
    inside = np.argwhere(body)
    names = ("visible", "hidden", "never_seen")
    labels = np.select([bare[name] for name in names], [1, 2, 3])
    got = np.select([wide[name] for name in names], [1, 2, 3])
    assert (got > 0).all()
    for i, j in np.random.default_rng(1).integers(0, SIZE, (300, 2)):
        distance = ((inside - [i, j]) ** 2).sum(1)
        ties = inside[distance == distance.min()]
        assert got[i, j] in labels[ties[:, 0], ties[:, 1]]


def test_a_silhouette_smaller_than_the_body_cuts_the_regions(half_hidden):
    view = truth_view(a_camera(), a_pose())
    upper = view.silhouette.copy()
    upper[SIZE // 2 :] = False
    found = half_hidden.regions(replace(view, silhouette=upper), REGIONS, PADDING)
    assert np.array_equal(found["visible"] | found["hidden"] | found["never_seen"], upper)


def test_nobody_in_the_picture(half_hidden):
    view = truth_view(a_camera(), a_pose(transl=(50, 0, 0)))
    assert not view.silhouette.any()
    found = half_hidden.regions(view, REGIONS, PADDING)
    assert not any(found[name].any() for name in ("body", "visible", "hidden", "never_seen", "box"))
    everywhere = half_hidden.regions(replace(view, silhouette=np.ones((SIZE, SIZE), bool)), REGIONS, PADDING)
    assert everywhere["never_seen"].all()


# ------------------------------------------------------------------------------------------------- the box


def test_the_box_is_the_outline_of_the_padded_world_box():
    """Against the half-planes of the projected corners' convex hull, to a pixel."""
    camera, vertices = a_camera(0.7, 120), BODY.pose(a_pose(0.3))
    low, high = vertices.min(0) - PADDING, vertices.max(0) + PADDING
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True)), -1).reshape(-1, 3)
    sides = ConvexHull(camera.project(corners)[:, :2]).equations
    rows, cols = np.mgrid[:120, :120] + 0.5
    outside_by = (np.stack([cols, rows], -1) @ sides[:, :2].T + sides[:, 2]).max(-1)  # px, negative inside
    box = projected_box(vertices, camera, PADDING)
    assert box[outside_by < -0.8].all()
    assert not box[outside_by > 0.8].any()
    assert (outside_by < -0.8).any()
    assert (outside_by > 0.8).any()


@pytest.mark.parametrize("depth", [0.0, 1e-9, -1e-9, 1e-6])
def test_a_box_that_reaches_the_camera_has_no_bounded_outline(depth):
    """The camera stands in the box, or a corner lies on its plane, or all but on it."""
    vertices = np.array([[-0.5, -0.5, -0.5], [0.5, 0.5, 0.5]])
    eye = np.array([0.0, 0.0, 0.5 + PADDING + depth])
    R, t = look_at(eye, np.zeros(3))
    assert projected_box(vertices, replace(a_camera(), R=R, t=t), PADDING).all()
    R, t = look_at(np.array([0.1, 0.0, 0.2]), np.array([1.0, 0, 0]))
    assert projected_box(vertices, replace(a_camera(), R=R, t=t), PADDING).all()
