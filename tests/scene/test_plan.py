"""What a scene needs: the measures against known scenes, and what follows from them."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ihbench.body import texel_table
from ihbench.body.pose import BodyPose
from ihbench.config_fields import as_json, flat, with_fields
from ihbench.methods.inpainthuman import config as method_config
from ihbench.methods.inpainthuman.config import (
    ONE_FIT_SHARE,
    PAPER,
    QUICK,
    RESIDUAL_SHARE,
    leave_out,
)
from ihbench.record.finished_run import earlier_runs
from ihbench.scene import plan
from ihbench.scene.plan import (
    LEAST_TEXELS,
    TEXELS,
    Omission,
    SceneMeasure,
    absent_regions,
    measure_scene,
)
from ihbench.scene.protocol import REGIONS
from ihbench.scene.views import open_scene
from ihbench.scene.visibility import texel_visibility
from tests.bench.fake_capture import (
    DISTANCE,
    DISTORTION,
    FOCAL,
    SIZE,
    FakeCapture,
    a_camera,
    a_pose,
    fake_protocol,
    the_body,
)
from tests.bench.fake_capture import turning_capture as turning
from tests.reports.fake_runs import identity

BODY = the_body()


def measured(capture, **changes):
    protocol = replace(fake_protocol(n_frames=capture.n_frames), **changes)
    return measure_scene(open_scene(capture, protocol))


def capture_of(roots=None, joint=None):
    """Frames with these root rotations [F, 3], or with this rotation [F, 3] of the left elbow."""
    poses = []
    for vector in roots if roots is not None else joint:
        pose = a_pose().pose.copy()
        pose[0 if roots is not None else 18] = vector
        poses.append(BodyPose(pose, np.zeros(10), np.zeros(3)))
    return FakeCapture(poses, [a_camera(size=32)] * 4)


@pytest.fixture(scope="module")
def moving():
    return measured(turning())


# ---------------------------------------------------------------------------------------------- measures


def test_counts_and_record(moving):
    assert (moving.training_views, moving.covered_views, moving.test_views) == (10, 8, 3 * 4)
    assert moving.occlusion["rule"] == "strip-generic"
    assert moving.occlusion["width"] > 0
    json.dumps(asdict(moving))
    assert measured(turning(), occlusion=fake_protocol(rule="none").occlusion).covered_views == 0


def test_shares_are_a_partition_of_the_surface(moving):
    shares = (moving.visible_texels, moving.hidden_texels, moving.never_seen_texels)
    assert sum(shares) == pytest.approx(1)
    assert all(0 < share < 1 for share in shares)


@pytest.mark.parametrize("distortion", [None, DISTORTION], ids=["pinhole", "distorted"])
def test_what_is_measured_on_raw_masks_holds_on_the_views_a_method_gets(distortion):
    capture, protocol = turning(distortion=distortion), fake_protocol(size=SIZE)
    scene = open_scene(capture, protocol)
    found = measure_scene(scene)
    seen = texel_visibility(scene.train, BODY, texel_table(BODY, TEXELS))
    assert found.visible_texels == pytest.approx(seen.visible.mean(), abs=0.04)
    assert found.hidden_texels == pytest.approx(seen.hidden.mean(), abs=0.04)
    assert found.never_seen_texels == pytest.approx(seen.never_seen.mean(), abs=0.02)
    assert found.hidden_share == pytest.approx(scene.hiding.hidden_share())


def test_large_images_are_reduced_without_a_shift():
    """Three times the size gives the same shares; at 768 px every third pixel is read."""
    strip = fake_protocol(strip=(128, 20), width=256).occlusion
    poses = [a_pose(k) for k in range(3)]
    small, large = (measured(FakeCapture(poses, [a_camera(size=s)] * 2), occlusion=strip) for s in (256, 768))
    assert large.hidden_share == pytest.approx(small.hidden_share, abs=0.01)
    for name in ("visible_texels", "hidden_texels", "never_seen_texels"):
        assert getattr(large, name) == pytest.approx(getattr(small, name), abs=0.01)
    assert large.pixel_mm == pytest.approx(small.pixel_mm)


def test_one_frame_shows_one_side():
    found = measured(capture_of(np.zeros((1, 3))))
    assert found.never_seen_texels > 0.5
    assert (found.training_views, found.motion_deg, found.turn_deg) == (1, 0, 0)


def test_a_pixel_and_a_texel_in_millimetres(moving):
    assert moving.pixel_mm == pytest.approx(1000 * DISTANCE / (FOCAL * 48 / SIZE), rel=0.03)
    assert measured(turning(), image=fake_protocol(size=SIZE).image).pixel_mm == pytest.approx(moving.pixel_mm / 2)
    # about 2.4 cm at 64² and 0.6 cm at 256² (protocols.md sec. 8, item 11): together the texels make up the skin
    corners = BODY.v_template[BODY.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    for resolution in (64, 256):
        texels = len(texel_table(BODY, resolution).face)
        assert texels * moving.texel_mm(resolution) ** 2 / 1e6 == pytest.approx(area, rel=0.04)


# ------------------------------------------------------------------------------------------ turn and motion


@pytest.mark.parametrize("degrees", [0, 90, 360, 540])
@pytest.mark.parametrize("world", ["y up", "z up", "z down"])
def test_the_turn_of_a_known_turn(degrees, world):
    yaw = np.linspace(-0.3, -0.3 + np.deg2rad(degrees), 7)
    tilt = Rotation.from_euler("x", {"y up": 0, "z up": 90, "z down": -90}[world], degrees=True)
    roots = (tilt * Rotation.from_euler("y", yaw[:, None])).as_rotvec()
    assert measured(capture_of(roots), occlusion=fake_protocol(rule="none").occlusion).turn_deg == pytest.approx(
        degrees, abs=1e-5
    )


def test_who_only_sways_does_not_turn():
    sway = np.random.default_rng(0).normal(0, 0.01, (12, 3))
    assert measured(capture_of(sway)).turn_deg < 5
    assert measured(capture_of(np.array([[0.0, 0, 0], [0, 1, 0]]))).turn_deg == pytest.approx(np.rad2deg(1))


@pytest.mark.parametrize("middle", [0.0, 0.5, np.pi])
def test_motion_is_the_largest_angle_between_two_frames(middle):
    """Also about π, where the axis-angle of a small motion jumps to the other side."""
    angle = middle + np.deg2rad([0, -20, 15, 5])
    rotations = Rotation.from_rotvec(np.outer(angle, [0.6, 0, 0.8])).as_rotvec()
    assert measured(capture_of(joint=rotations)).motion_deg == pytest.approx(35, abs=1e-5)


def test_motion_does_not_depend_on_how_rotations_are_written():
    rotations = np.tile([0.2, -0.4, 0.3], (4, 1))
    rotations[1] *= 1 - 2 * np.pi / np.linalg.norm(rotations[1])
    rotations[2] *= 1 + 2 * np.pi / np.linalg.norm(rotations[2])
    assert measured(capture_of(joint=rotations)).motion_deg < 1e-3
    assert measured(capture_of(np.random.default_rng(0).normal(0, 1, (4, 3)))).motion_deg < 1e-3, "the root counts"


# ------------------------------------------------------------------------------------------- what is left out


def test_a_moving_person_keeps_the_pose_residual_and_a_static_one_does_not(moving):
    static = measured(FakeCapture([a_pose(yaw) for yaw in np.linspace(0, 5, 6)], [a_camera()] * 4))
    assert static.turn_deg > 180
    left_out = leave_out(QUICK, static)
    assert [(o.field, o.value) for o in left_out if o.field == "pose_residual"] == [("pose_residual", False)]
    assert "0.0°" in next(o.reason for o in left_out if o.field == "pose_residual")
    assert not [o for o in leave_out(QUICK, moving) if o.field == "pose_residual"]
    assert not [o for o in leave_out(replace(QUICK, pose_residual=False), static) if o.field == "pose_residual"]


@pytest.mark.parametrize(
    ("pixel_mm", "levels"), [(1.0, (64, 128, 256)), (20.0, (64, 128)), (40.0, (64,)), (500.0, (64,))]
)
@pytest.mark.parametrize("config", [QUICK, PAPER], ids=["quick", "paper"])
def test_levels_finer_than_the_pixels_are_left_out(moving, config, pixel_mm, levels):
    """Texels of 23, 11.5 and 5.8 mm; the limit is a third of a pixel. However far the camera, one level stays."""
    left_out = [o for o in leave_out(config, replace(moving, pixel_mm=pixel_mm)) if o.field == "levels"]
    assert [o.value for o in left_out] == ([] if levels == config.levels else [levels])
    assert all(f"{pixel_mm:.1f} mm" in o.reason for o in left_out)


@pytest.mark.parametrize("config", [QUICK, PAPER], ids=["quick", "paper"])
@pytest.mark.parametrize("pixel_mm", [1.0, 12.0, 24.0, 50.0, 5000.0])
def test_no_more_gaussians_than_the_pixels_can_tell_apart(moving, config, pixel_mm):
    scene = replace(moving, pixel_mm=pixel_mm)
    left_out = [o.value for o in leave_out(config, scene) if o.field == "texels"]
    texels = left_out[0] if left_out else config.texels
    assert texels == LEAST_TEXELS or scene.texel_mm(texels // 2) > pixel_mm / 2  # half as many would be too few
    assert texels == config.texels or scene.texel_mm(texels) <= pixel_mm / 2
    assert bool(left_out) == (scene.texel_mm(config.texels // 2) <= pixel_mm / 2)


def test_a_far_camera_makes_the_pixels_coarse():
    far = measured(FakeCapture([a_pose(k) for k in range(3)], [a_camera(distance=9.0, size=256)] * 4))
    near = measured(FakeCapture([a_pose(k) for k in range(3)], [a_camera(size=256)] * 4))
    assert far.pixel_mm == pytest.approx(3 * near.pixel_mm, rel=0.02)
    assert [o.value for o in leave_out(QUICK, far) if o.field == "levels"] == [(64,)]


def test_a_word_is_learned_only_for_a_model_to_which_it_is_worth_something(moving):
    def word(scene=moving, **changes):
        config = replace(QUICK, inpaint=replace(QUICK.inpaint, **changes))
        return [o.value for o in leave_out(config, scene) if o.field == "inpaint.ti"]

    assert word() == word(turntable=4) == word(context="frame") == [False]
    for own in (
        {"backbone": "sd2", "weights": "x"},
        {"weights": "x"},
        {"ti": False},
        {"on": False},
        {"filler": "mean"},
    ):
        assert word(**own) == []
    assert word(replace(moving, hidden_texels=0.001)) == [], "nothing is painted, so no word is left out"


def test_nothing_is_painted_where_every_frame_shows_all(moving, monkeypatch):
    seen = replace(moving, hidden_texels=0.001)
    (omission,) = [o for o in leave_out(QUICK, seen) if o.field == "one_fit"]
    assert omission.value is True
    assert "0.1%" in omission.reason
    assert not [o for o in leave_out(QUICK, replace(moving, hidden_texels=0.02)) if o.field == "one_fit"]
    for needed in ({"turntable": 4}, {"context": "frame"}, {"on": False}, {"always": True}):
        config = replace(QUICK, inpaint=replace(QUICK.inpaint, **needed))
        assert not [o for o in leave_out(config, seen) if o.field == "one_fit"]
    for other in ({"steps": 0}, {"steps": 400}, {"ssim": 0.0}):  # another stage 3 than the one it was compared with
        config = replace(QUICK, refine=replace(QUICK.refine, **other))
        assert not [o for o in leave_out(config, seen) if o.field == "one_fit"]
    assert not [o for o in leave_out(PAPER, seen) if o.field == "one_fit"]
    monkeypatch.setattr(method_config, "locate", lambda file: Path("trunk"))  # stage 3 has LPIPS, the one fit has not
    assert not [o for o in leave_out(QUICK, seen) if o.field == "one_fit"]


def test_glancing_surface_is_not_painted_where_the_person_turns_in_part(moving):
    turned, part = (replace(moving, hidden_texels=0.05, never_seen_texels=share) for share in (0.015, 0.15))
    (omission,) = [o for o in leave_out(QUICK, part) if o.field == "inpaint.facing"]
    assert 0 < omission.value < 1
    assert "15%" in omission.reason
    assert not [o for o in leave_out(QUICK, turned) if o.field == "inpaint.facing"]
    for needless in ({"turntable": 4}, {"context": "frame"}, {"on": False}, {"always": True}, {"facing": 0.7}):
        config = replace(QUICK, inpaint=replace(QUICK.inpaint, **needless))
        assert not [o for o in leave_out(config, part) if o.field == "inpaint.facing"], needless


def test_omissions_name_fields_of_the_configuration(moving):
    for o in leave_out(QUICK, replace(moving, motion_deg=0.0, pixel_mm=40.0, hidden_texels=0.0)):
        assert o.value != flat(QUICK)[o.field]
        assert flat(with_fields(QUICK, {o.field: o.value}))[o.field] == o.value


def test_regions_without_a_texel_are_absent_with_a_reason(moving):
    assert absent_regions(moving, REGIONS) == []
    nothing = replace(moving, hidden_texels=0.0, never_seen_texels=0.0)
    assert [o.field for o in absent_regions(nothing, REGIONS)] == ["hidden", "never_seen"]
    assert all(len(o.reason) > 20 for o in absent_regions(nothing, REGIONS))
    assert absent_regions(nothing, ("body", "full")) == []
    bare = measured(turning(), occlusion=fake_protocol(rule="none").occlusion)
    assert [o.field for o in absent_regions(bare, REGIONS)] == ["hidden"]


def test_only_some_of_many_views_are_read(monkeypatch):
    """Every frame counts for motion, a few that are evenly spread for visibility."""
    monkeypatch.setattr(plan, "MEASURE_VIEWS", 6)
    poses = [a_pose(0.1 * k, arms=1.0 if k == 29 else 0.0) for k in range(51)]
    read = set()
    capture = FakeCapture(poses, [a_camera(size=48)] * 4, edit_silhouette=lambda c, f, pixels: read.add(f) or pixels)
    found = measured(capture, occlusion=fake_protocol(rule="none").occlusion)
    assert read == {0, 10, 20, 30, 40, 50}
    assert found.training_views == 51
    assert found.motion_deg > 50


# ---------------------------------------------------------------------------------------------- expected time


def a_run(
    seconds, method="inpainthuman", profile="quick", status="done", protocol="p@1", cpu="one", code="1", **about
):
    own = identity("a", method, profile=profile, protocol=protocol, code=code)
    stages = {"fit/stage1": {"seconds": 0.5 * seconds}} if isinstance(seconds, int) else {}
    return {
        "schema_version": 1,
        "status": status,
        "reason": "",
        "digest": own.digest,
        "identity": as_json(own),
        "about": {"total_seconds": seconds, "changed": [], "left_out": [], **about},
        "created": "2025-01-01T00:00:00+00:00",
        "machine": {"cpu": cpu},
        "ledger": {"stages": stages, "seconds": 0.0, "cpu_seconds": 0.0, "events": []},
        "warnings": [],
    }


def runs_of(folder, records):
    for k, record in enumerate(records):
        (folder / str(k)).mkdir()
        (folder / str(k) / "run.json").write_text(json.dumps(record))
    return folder


def test_expected_seconds_are_the_median_of_finished_runs_alike(tmp_path):
    def seconds(method="inpainthuman", protocol="p@1", profile="quick", cpu="one", code="1"):
        found = earlier_runs(tmp_path, method, protocol, profile, cpu, code)
        assert found is None or found.same_code == (code == "1" or profile == "paper")
        return None if found is None else (found.seconds, found.count, found.same_switches)

    assert seconds() is None
    records = [a_run(10), a_run(30), a_run(100), a_run(999, status="failed")]
    records += [a_run(5, profile="paper", code="2"), a_run(77, code="0"), a_run(88, code="0")]
    records += [a_run(1, method="other"), {"status": "done"}, [], a_run("soon"), a_run(None)]
    records += [a_run(2, protocol="p@1+size=64"), a_run(3, cpu="two"), a_run(4, changed=["steps=60"])]
    records += [a_run(7, cpu="three", changed=["steps=60"])]
    runs_of(tmp_path, records)
    (tmp_path / "cut").mkdir()
    (tmp_path / "cut" / "run.json").write_text('{"status": "do')
    assert seconds() == (30, 3, True)
    assert seconds(code="other") == (77, 5, True)  # none of this code: all that there are
    assert seconds(profile="paper", code="2") == (5, 1, True)
    assert seconds(protocol="p@1+size=64") == (2, 1, True)
    assert seconds(cpu="two") == (3, 1, True)
    assert seconds(cpu="three") == (7, 1, False)
    assert seconds(method="another") is None


def test_what_an_omission_saves_is_its_share_of_the_stages_of_earlier_runs(tmp_path, moving):
    records = [a_run(10), a_run(30), a_run(100)]
    records[2]["ledger"]["stages"] |= {"fit/stage2": {"seconds": 40}, "fit/stage3": {"seconds": 20}}
    records.append(a_run(2, left_out=[{"field": "texels", "value": 64, "reason": ""}]))  # did less
    records[0]["about"]["left_out"] = [{"field": "never_seen", "value": None, "reason": ""}]  # a region, no work
    earlier = earlier_runs(runs_of(tmp_path, records), "inpainthuman", "p@1", "quick", "one", "1")
    stages = earlier.stages
    assert stages == {"fit/stage1": 15, "fit/stage2": 40, "fit/stage3": 20}
    found = {o.field: o.seconds(stages) for o in leave_out(QUICK, replace(moving, motion_deg=0.0, hidden_texels=0.0))}
    assert found["one_fit"] == 60 - ONE_FIT_SHARE * 15
    assert found["pose_residual"] == pytest.approx(RESIDUAL_SHARE * 35)
    assert Omission("hidden", None, "why").seconds(stages) is None
    assert Omission("x", 1, "why", {"fit/stage9": 1.0}).seconds(stages) is None


def test_a_measure_can_be_made_by_hand():
    """Methods of others build one for their own tests."""
    scene = SceneMeasure(1, 0, 1, 0, 1, 0, 0, motion_deg=0, turn_deg=0, pixel_mm=3, surface_mm=1500, occlusion={})
    assert [o.field for o in leave_out(QUICK, scene)] == ["pose_residual", "one_fit"]
