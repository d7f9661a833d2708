"""What training showed of the surface: laws, and a ray caster as oracle."""

from dataclasses import replace

import numpy as np
import pytest

from ihbench.body import JOINT_INDEX, texel_table
from ihbench.body.pose import BodyPose
from ihbench.camera import look_at
from ihbench.scene.contracts import MaskState
from ihbench.scene.visibility import FACING, PosedSurface, texel_visibility
from tests.bench.fake_capture import DISTORTION, SIZE, a_camera, a_pose, the_body, train_view

RESOLUTION = 64
BODY = the_body()
TEXELS = texel_table(BODY, RESOLUTION)
CENTRE = slice(SIZE // 2 - 6, SIZE // 2 + 6)
HEADINGS = np.linspace(0, 2 * np.pi, 8, endpoint=False)


def with_state(view, state):
    return replace(view, mask=np.full_like(view.mask, state))


def surface(body_pose):
    """Points [N, 3] and unit normals [N, 3] of the texels."""
    corners = BODY.pose(body_pose)[BODY.faces[TEXELS.face]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.einsum("nk,nkd->nd", TEXELS.bary, corners), normals / np.linalg.norm(normals, axis=1, keepdims=True)


def cosine(camera, body_pose):
    points, normals = surface(body_pose)
    direction = camera.center - points
    return (normals * direction).sum(1) / np.linalg.norm(direction, axis=1)


def first_hit(camera, body_pose, chosen):
    """[n] how far before each chosen texel, in m along the ray from the camera, the first surface lies."""
    vertices = BODY.pose(body_pose)
    a, b, c = (vertices[BODY.faces[:, k]] for k in range(3))
    e1, e2, s = b - a, c - a, camera.center - a
    q = np.cross(s, e1)
    out = []
    for point in surface(body_pose)[0][chosen]:
        length = np.linalg.norm(point - camera.center)
        direction = (point - camera.center) / length
        p = np.cross(direction, e2)
        det = (e1 * p).sum(1)
        det = np.where(np.abs(det) < 1e-12, np.nan, det)
        u, v, t = (s * p).sum(1) / det, (q @ direction) / det, (e2 * q).sum(1) / det
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
        out.append(length - t[hit].min())
    return np.array(out)


def arms_down():
    pose = a_pose().pose.copy()
    pose[[JOINT_INDEX["left_shoulder"], JOINT_INDEX["right_shoulder"]], 2] = [-1.45, 1.45]
    return BodyPose(pose, np.zeros(10), np.zeros(3))


@pytest.mark.parametrize("distortion", [None, DISTORTION], ids=["pinhole", "distorted"])
def test_a_ray_caster_agrees(distortion):
    """From the side an arm hangs close before the body. The z-buffer knows depth at pixel centres only, hence the
    slack of a few percent near outlines."""
    camera, pose = a_camera(1.2, 256, distortion=distortion), arms_down()
    faced = PosedSurface(BODY, camera, pose).faced(TEXELS)
    nearest = np.isin(np.arange(len(TEXELS.face)), faced.texel)
    place, facing = TEXELS.interpolate(BODY.v_template, BODY.faces), cosine(camera, pose)
    trunk = (np.abs(place[:, 0]) < 0.22) & (place[:, 1] > -0.1) & (place[:, 1] < 0.45)
    chosen = np.flatnonzero(trunk & (facing > FACING))
    before = first_hit(camera, pose, chosen)
    for low, high in ((0.04, 0.14), (0.14, np.inf)):
        hidden = (before > low) & (before < high)
        assert hidden.sum() > 20, "nothing hides anything: the test shows nothing"
        assert nearest[chosen][hidden].mean() < 0.1
    shown = (before < 1e-6) & (facing[chosen] > 0.3)
    assert shown.sum() > 80
    assert nearest[chosen][shown].mean() > 0.97
    pixels = camera.project(surface(pose)[0])[nearest, :2]
    np.testing.assert_array_equal(np.floor(pixels), np.column_stack(faced.pixel[::-1]))


def test_what_faces_away_is_never_seen():
    """Over several headings; the limit itself is FACING."""
    for heading in HEADINGS[:4]:
        view = train_view(a_camera(), a_pose(heading))
        seen = texel_visibility([view], BODY, TEXELS)
        assert not seen.faced[cosine(view.camera, view.body_pose) <= FACING].any()


def test_the_front_is_seen_and_the_back_is_not():
    view = train_view(a_camera(), a_pose())
    seen = texel_visibility([view], BODY, TEXELS)
    facing = cosine(view.camera, view.body_pose)
    assert seen.never_seen[facing < 0].all()
    assert seen.visible[facing > 0.6].mean() > 0.95
    assert not seen.hidden.any()


def test_a_full_turn_shows_nearly_everything_and_half_a_turn_does_not():
    views = [train_view(a_camera(), a_pose(heading)) for heading in HEADINGS]
    assert texel_visibility(views, BODY, TEXELS).visible.mean() > 0.96
    assert texel_visibility(views[:1] + views[-1:] + views[1:2], BODY, TEXELS).never_seen.mean() > 0.1


def test_every_texel_is_visible_or_hidden_or_never_seen():
    views = [train_view(a_camera(), a_pose(heading, 0.3), CENTRE) for heading in HEADINGS[:3]]
    seen = texel_visibility(views, BODY, TEXELS)
    labels = np.stack([seen.visible, seen.hidden, seen.never_seen])
    assert (labels.sum(0) == 1).all()
    assert labels.any(1).all()
    assert (seen.seen <= seen.faced).all()
    assert (seen.faced <= len(views)).all()


def test_an_occluder_hides_and_one_clear_view_makes_up_for_it():
    clear = with_state(train_view(a_camera(), a_pose()), MaskState.PERSON)  # no known background at the rim
    covered = with_state(clear, MaskState.UNKNOWN)
    shown = texel_visibility([clear], BODY, TEXELS)
    hidden = texel_visibility([covered] * 3, BODY, TEXELS)
    assert np.array_equal(hidden.hidden, shown.visible)
    assert np.array_equal(hidden.never_seen, shown.never_seen)
    assert not hidden.visible.any()
    both = texel_visibility([covered, clear, covered], BODY, TEXELS)
    assert np.array_equal(both.visible, shown.visible)
    assert both.faced.sum() == 3 * both.seen.sum()


def test_only_what_projects_into_the_strip_is_hidden():
    view = train_view(a_camera(), a_pose(), CENTRE)
    seen = texel_visibility([view], BODY, TEXELS)
    column = np.floor(view.camera.project(surface(view.body_pose)[0])[:, 0])
    inside = (column >= CENTRE.start) & (column < CENTRE.stop)
    assert seen.hidden.sum() > 100
    assert not seen.hidden[~inside].any()
    assert not seen.visible[inside].any()


def test_a_texel_over_known_background_counts_as_neither():
    view = train_view(a_camera(), a_pose())
    nothing = texel_visibility([with_state(view, MaskState.BACKGROUND)], BODY, TEXELS)
    assert nothing.never_seen.all()
    rim = texel_visibility([view], BODY, TEXELS).faced.sum()
    assert rim < texel_visibility([with_state(view, MaskState.PERSON)], BODY, TEXELS).faced.sum()


def test_a_camera_that_looks_away_sees_nothing():
    camera = a_camera()
    R, t = look_at(camera.center, 2 * camera.center)
    behind = replace(with_state(train_view(camera, a_pose()), MaskState.PERSON), camera=replace(camera, R=R, t=t))
    assert texel_visibility([behind], BODY, TEXELS).never_seen.all()
    assert texel_visibility([], BODY, TEXELS).never_seen.all()


def test_only_the_relative_place_of_camera_and_body_matters():
    """A camera a quarter to the left of the person, or the person turned a quarter to the right."""
    turned = texel_visibility([train_view(replace_height(a_camera(0.0)), a_pose(-1.0))], BODY, TEXELS)
    moved = texel_visibility([train_view(replace_height(a_camera(1.0)), a_pose())], BODY, TEXELS)
    assert (turned.visible == moved.visible).mean() > 0.985


def replace_height(camera):
    """The same camera at the height of the body's root and level, so that turning either is the same."""
    eye = camera.center * [1, 0, 1]
    R, t = look_at(eye, np.zeros(3))
    return replace(camera, R=R, t=t)
