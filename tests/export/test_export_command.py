"""`ihbench export`: every format of a finished run, read back by readers of their own."""

import io

import numpy as np
import pytest
from PIL import Image

from ihbench import registry
from ihbench.body.canonical import canonical_pose
from ihbench.body.pose import BodyPose
from ihbench.errors import BadInput
from ihbench.export.about import licence
from ihbench.files.splat_ply import read_splat_ply
from ihbench.record.finished_run import FinishedRun
from ihbench.runner.run_loop import load_avatar
from ihbench.show.motion import read_motion, stand_of, up_axis
from ihbench.show.subject import Subject
from tests.export.glb_reader import GlbFile
from tests.show.test_render_command import gallery, mannequin_run

__all__ = ["gallery", "mannequin_run"]


def ply_of(path):
    """Comments, and column by name: a reader that knows no more than the format."""
    head, body = path.read_bytes().split(b"end_header\n", 1)
    lines = head.decode("ascii").splitlines()
    names = [line.split()[-1] for line in lines if line.startswith("property float")]
    table = np.frombuffer(body, np.dtype([(name, "<f4") for name in names]))
    return [line.removeprefix("comment ") for line in lines if line.startswith("comment")], table


@pytest.mark.parametrize("pose", ["a_pose", "120"])
def test_a_ply_has_the_gaussians_of_the_pose_upright_in_viewers(bench, finished, tmp_path, pose):
    words, out = ("export", finished.folder, "--to", "ply", "--pose", pose), tmp_path / "avatar.ply"
    outcome = bench(*words, "--axes", "world", "--footprint", "0", "--out", out)
    assert outcome.status == 0, outcome.err
    means, scales, colors = read_splat_ply(out.read_bytes())
    with bench.in_its_world():
        subject = Subject(FinishedRun(finished.folder))
        avatar, body, pixel = subject.avatar, subject.body, subject.pixel
        named = BodyPose(canonical_pose("a_pose"), avatar.betas, np.zeros(3))
        body_pose = subject.run.capture.body_pose(120) if pose == "120" else named
        expected = [value.numpy() for value in avatar.gaussians(body_pose)]
    assert len(means) == len(avatar) > 100
    np.testing.assert_allclose(means, expected[0], atol=1e-6)
    np.testing.assert_allclose(scales, expected[1], rtol=1e-5)
    np.testing.assert_allclose(colors, expected[2], atol=1e-6)

    assert bench(*words, "--out", out).status == 0
    said, table = ply_of(out)
    seen = np.stack([table[name] for name in "xyz"], 1)
    stand = stand_of(body, BodyPose(body_pose.pose, avatar.betas, body_pose.transl), up_axis([body_pose]))
    np.testing.assert_allclose(seen * (-1, -1, 1) @ stand.axes.T + stand.pelvis, means, atol=1e-5)
    # viewers turn a PLY by 180 degrees about z and have y up then
    up = -seen[:, 1]
    joints = body.posed_joints(BodyPose(body_pose.pose, avatar.betas, body_pose.transl))
    own = (joints - stand.pelvis) @ stand.axes
    head = np.linalg.norm(seen * (-1, -1, 1) - own[15], axis=1) < 0.2
    foot = np.linalg.norm(seen * (-1, -1, 1) - own[10], axis=1) < 0.2
    assert up[head].mean() > 0.3 > -0.3 > up[foot].mean()
    np.testing.assert_allclose(np.exp(table["scale_1"]) ** 2, scales**2 + 0.275 * pixel**2, rtol=1e-4)
    assert said[2:] == [
        "data: stand-in v2 seed 0: a person made by the bench",
        f"pose: {pose}",
        "units: metres",
        f"widened by: {1000 * 0.275**0.5 * pixel:.3g} mm (standard deviation), the blur of a training image's pixel",
        "axes: y down, z forward (180 degrees about z from y-up); the pelvis at the origin",
        "SplatRenderMode: default",
    ]


def test_a_file_lies_in_the_run_folder_unless_told_otherwise(bench_with_run):
    (folder,) = bench_with_run.folders()
    outcome = bench_with_run("export", folder)
    assert str(folder / "avatar.ply") in outcome.out
    assert len(read_splat_ply((folder / "avatar.ply").read_bytes())[0]) > 100


def test_a_frames_pose_never_takes_another_person(bench_with_run, tmp_path):
    """standin-1 of another cast has the same name and another body."""
    (folder,) = bench_with_run.folders()
    with bench_with_run.in_its_world():
        registry.load("stand-in", "zju_mocap").ensure(tmp_path / "cast", 1, ["standin-1"], {0: [0]})
    outcome = bench_with_run("export", folder, "--pose", "0", "--data", tmp_path / "cast")
    assert outcome.status == 2
    assert "holds stand-in v2 seed 1, the run was made on stand-in v2 seed 0" in outcome.err


def test_without_the_data_nothing_is_widened_and_a_line_says_so(bench, finished, tmp_path, monkeypatch):
    def refused(*_):
        raise BadInput("no data")

    monkeypatch.setattr("ihbench.show.subject.training_pixel", refused)
    outcome = bench("export", finished.folder, "--out", tmp_path / "a.ply")
    assert (outcome.status, outcome.err.count("\n")) == (0, 1)
    assert "its data are not at hand" in outcome.err
    said = ply_of(tmp_path / "a.ply")[0]
    assert "units: metres" in said
    assert not any(line.startswith("widened") for line in said)
    drawn = bench("render", finished.folder, "--orbit", "1", "--size", "32", "--out", tmp_path / "seen")
    assert (drawn.status, "its data are not at hand" in drawn.err) == (0, True)


def test_a_sequence_is_numbered_and_has_one_origin(bench, finished, tmp_path):
    np.savez(tmp_path / "m.npz", poses=np.zeros((3, 72)), trans=np.arange(9).reshape(3, 3) / 10, mocap_framerate=5)
    words = ("export", finished.folder, "--to", "ply-sequence", "--fps", "5", "--footprint", "0")
    outcome = bench(*words, "--motion", tmp_path / "m.npz", "--out", tmp_path / "seq")
    assert outcome.status == 0, outcome.err
    files = sorted(path.name for path in (tmp_path / "seq").glob("*.ply"))
    assert files == ["avatar_0001.ply", "avatar_0002.ply", "avatar_0003.ply"]
    tables = [ply_of(tmp_path / "seq" / name) for name in files]
    means = [np.stack([table[name] for name in "xyz"], 1) for _, table in tables]
    step = np.array([0.3, 0.3, 0.3]) * (-1, -1, 1)
    np.testing.assert_allclose(means[1] - means[0], np.tile(step, (len(means[0]), 1)), atol=1e-5)
    assert "pose: frame 2 of 3 of m, 5 frames a second" in tables[1][0]
    shorter = bench(*words, "--motion", "bow", "--fps", "1", "--out", tmp_path / "seq")
    assert (shorter.status, "avatar_0003.ply of a longer sequence" in shorter.err) == (2, True)


def test_a_splat_gltf_is_the_ply_with_y_up(bench, finished, tmp_path):
    for kind, name in (("ply", "a.ply"), ("glb-splats", "a.glb")):
        assert bench("export", finished.folder, "--to", kind, "--out", tmp_path / name).status == 0
    a = GlbFile((tmp_path / "a.glb").read_bytes()).attributes()
    _, table = ply_of(tmp_path / "a.ply")
    np.testing.assert_allclose(a["POSITION"], np.stack([table[n] for n in "xyz"], 1) * (-1, -1, 1), atol=1e-6)
    own = "KHR_gaussian_splatting:"
    np.testing.assert_allclose(a[own + "SCALE"][:, 0], np.exp(table["scale_0"]), rtol=1e-5)
    dc = np.stack([table[f"f_dc_{k}"] for k in range(3)], 1)
    np.testing.assert_allclose(a[own + "SH_DEGREE_0_COEF_0"], dc, atol=1e-5)


def test_a_mesh_moves_has_a_texture_and_says_where_it_is_from(bench, finished, tmp_path):
    out = tmp_path / "a.glb"
    words = ("export", finished.folder, "--to", "glb", "--fps", "5", "--motion", "march", "bow", "--out", out)
    outcome = bench(*words)
    assert outcome.status == 0, outcome.err
    assert "the clips march (2.0 s), bow (2.0 s)" in outcome.out
    file = GlbFile(out.read_bytes())
    file.check_bounds()
    assert [clip["name"] for clip in file.json["animations"]] == ["march", "bow"]
    (about,) = [node["extras"] for node in file.json["nodes"] if "mesh" in node]
    assert (about["method"], about["scene"], about["pose_blend_shapes"]) == ("inpainthuman", "standin-1", False)
    assert about["texture"].startswith("colours and places of the avatar's")
    stands = file.posed()
    assert stands[:, 1].min() == pytest.approx(0, abs=1e-4)
    assert stands[:, 1].max() > 1.3
    heights = [file.posed(*file.at(1, key))[:, 1].max() for key in (0, 5)]
    assert heights[1] < heights[0] - 0.2  # bowed
    outcome = bench("export", finished.folder, "--to", "texture", "--out", tmp_path / "t.png")
    assert outcome.status == 0, outcome.err
    picture = Image.open(tmp_path / "t.png")
    inside = Image.open(io.BytesIO(file.view(file.json["images"][0]["bufferView"])))
    assert np.array_equal(np.asarray(picture), np.asarray(inside))
    assert picture.text["scene"] == "standin-1"


def test_a_method_without_gaussians_is_a_mesh_too(bench, mannequin_run, tmp_path, monkeypatch):
    monkeypatch.setattr("ihbench.export.texture.PICTURE", 160)
    monkeypatch.setattr("ihbench.export.texture.AROUND", 4)
    out = tmp_path / "m.glb"
    words = ("export", mannequin_run, "--to", "glb", "--motion", "turn", "--fps", "2", "--texture-size", "64")
    outcome = bench(*words, "--out", out)
    assert outcome.status == 0, outcome.err
    file = GlbFile(out.read_bytes())
    texture = np.asarray(Image.open(io.BytesIO(file.view(file.json["images"][0]["bufferView"]))))
    assert np.abs(texture.astype(int) - 128).max() <= 2  # its one grey
    for kind in ("ply", "glb-splats"):
        refused = bench("export", mannequin_run, "--to", kind, "--out", tmp_path / "x")
        assert (refused.status, "no Gaussians" in refused.err) == (2, True)


def test_a_motion_for_other_programs_is_read_back(bench, finished, tmp_path):
    out = tmp_path / "m.npz"
    outcome = bench("export", finished.folder, "--to", "amass", "--motion", "capture", "--fps", "10", "--out", out)
    assert outcome.status == 0, outcome.err
    with bench.in_its_world():
        subject = Subject(FinishedRun(finished.folder))
        own = subject.motion("capture", 10)
        back = read_motion(out, subject.body, subject.betas)
        poses = back.body_poses(subject.betas)
        floor = min(subject.body.pose(p)[:, 2].min() for p in poses)
        assert np.array_equal(up_axis(poses), [0, 0, 1])
    assert (len(back), back.fps) == (len(own), 10)
    np.testing.assert_allclose(back.pose[:, 1:22], own.pose[:, 1:22], atol=1e-12)
    assert floor == pytest.approx(0, abs=1e-6)
    arrays = np.load(out)
    assert {"poses", "trans", "betas", "gender", "mocap_framerate"} <= set(arrays.files)
    assert arrays["poses"].shape == (len(own), 156)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--to", "glb", "--axes", "splat"), "y-up, as glTF says"),
        (("--to", "amass", "--motion", "bow", "--axes", "y-up"), "z-up"),
        (
            (
                "--to",
                "ply-sequence",
            ),
            "needs a --motion",
        ),
        (("--to", "amass", "--motion", "bow", "march"), "expected one"),
        (("--to", "glb", "--motion", "marsh"), "did you mean 'march'"),
        (("--pose", "b_pose"), "did you mean 'big_pose'"),
    ],
)
def test_what_does_not_fit_is_said_in_a_line(bench, finished, words, said):
    outcome = bench("export", finished.folder, *words)
    assert (outcome.status, outcome.out, outcome.err.count("\n")) == (2, "", 1), outcome.err
    assert said in outcome.err


def test_files_that_hold_the_smpl_body_say_that_they_may_not_be_passed_on(bench, finished, tmp_path, monkeypatch):
    from dataclasses import replace

    with bench.in_its_world():
        own = load_avatar(FinishedRun(finished.folder)).body
    smpl = replace(own, name="smpl")
    assert "not for redistribution" in licence(smpl, holds_body=True)
    assert "no part of the SMPL" in licence(smpl, holds_body=False)
    monkeypatch.setattr(Subject, "body", smpl)
    outcome = bench("export", finished.folder, "--to", "glb", "--fps", "1", "--out", tmp_path / "a.glb")
    assert outcome.status == 0, outcome.err
    assert "not for redistribution" in outcome.err
    file = GlbFile((tmp_path / "a.glb").read_bytes())
    assert "not for redistribution" in file.json["asset"]["copyright"]
    (about,) = [node["extras"] for node in file.json["nodes"] if "mesh" in node]
    assert "not for redistribution" in about["licence"]
