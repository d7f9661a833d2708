"""Protocols beside zju_occ, end to end: severities, groups of test views, one's own video, handing out and back."""

from __future__ import annotations

import json

import numpy as np
import pytest

from ihbench.body import load_body, write_body
from ihbench.cli import main
from ihbench.clock.progress import Progress
from ihbench.datasets.plain import plain_scene
from ihbench.errors import BadInput
from ihbench.files.images import write_png
from ihbench.metrics import Identity
from ihbench.record.results import read_result
from ihbench.scene.data_source import body_file, locate
from ihbench.scene.protocol import load_protocol
from ihbench.scene.views import open_scene
from tests.bench.fake_capture import a_camera, a_pose, photograph


@pytest.fixture(scope="module")
def own_video(tmp_path_factory):
    """A plain scene folder of ten frames with a body of its own, as somebody's pose estimator would leave it."""
    folder = tmp_path_factory.mktemp("video") / "mein Vidéo"
    camera = a_camera(size=96)
    poses = [a_pose(0.5 * k, 0.3) for k in range(10)]
    plain_scene.write_cameras(folder, {"phone": camera})
    plain_scene.write_poses(folder, poses)
    write_body(folder / "body.npz", load_body())
    for k, pose in enumerate(poses):
        plain_scene.write_frame(folder, k, *photograph(camera, pose))
    return folder


def test_any_person_of_a_stand_in_can_be_named():
    protocol = load_protocol("people_snapshot_occ", "quick")
    assert locate(protocol, None, ("standin-8", "standin-2")).scenes == ("standin-8", "standin-2")
    assert locate(protocol, None, ()).scenes == protocol.subjects.standin
    for name in ("standin-0", "standin-08", "standin-100", "male-3-casual"):
        with pytest.raises(BadInput, match=f"unknown scene '{name}'"):
            locate(protocol, None, (name,))


def test_a_video_of_ones_own_runs_with_its_own_body(own_video, tmp_path, mannequin, bench, capsys):
    words = [
        "run",
        "--protocol",
        "custom_occ",
        "--data",
        own_video,
        "--runs",
        tmp_path,
        "--method",
        "mannequin",
        "--full",
    ]
    with bench.in_its_world():
        status = main([str(w) for w in (*words, "--occlusion.rule", "central-band", "--occlusion.fraction", "0.3")])
    assert status == 0, capsys.readouterr().err
    (folder,) = (p.parent for p in tmp_path.glob("*/run.json"))
    result = read_result(folder)
    assert result.about.body == "own"
    assert result.about.standin == ""
    assert result.identity.protocol == "custom_occ@1+occlusion=central-band,fraction=0.3"
    assert 0.3 <= result.about.hidden_share < 0.36
    report = bench("report", folder, "--preset", "gauhuman", "--data", own_video)
    assert report.status == 0, report.err
    assert "real data (plain)" in report.out


def test_frames_are_flags(own_video):
    protocol = load_protocol("custom_occ").with_fields({"train.frames": "0:8:4", "test.frames": "1::3"})
    scene = open_scene(*_opened(protocol, own_video))
    assert scene.hiding.frames == (0, 4)
    assert [key.frame for key in scene.test_keys] == [1, 4, 7]
    assert protocol.name == "custom_occ@1+train=0:8:4+test=1::3"
    assert protocol.digest != load_protocol("custom_occ").digest
    for bad in ("a:b", "5", "3:1", "0:9:0", "-1:5"):
        with pytest.raises(BadInput, match=r"START:STOP:STEP|stop above"):
            load_protocol("custom_occ").with_fields({"train.frames": bad})


def _opened(protocol, data, scene=None):
    source = locate(protocol, data, (scene,) if scene else ())
    capture, _ = source.open(source.scenes[0], None, Progress.silent())
    return capture, protocol


@pytest.mark.parametrize(
    "rule", ["strip-generic", "central-band", "side", "lower-half", "upper-half", "blocks", "object"]
)
def test_severity_asked_is_severity_hidden(bench, rule):
    """On a stand-in, within 2 % of the person; the strip is as coarse as two of its columns."""
    with bench.in_its_world():
        for fraction in (0.1, 0.3, 0.5, 0.7, 0.9):
            protocol = load_protocol(str(bench.protocol)).with_fields(
                {"occlusion.rule": rule, "occlusion.fraction": fraction}
            )
            hidden = open_scene(*_opened(protocol, None, "standin-1")).hiding.hidden_share()
            assert fraction <= hidden <= fraction + 0.02, (fraction, hidden)


def test_several_severities_are_several_runs(bench, mannequin):
    outcome = bench.run("--occlusion.fraction", "0.2", "0.6", "--runs", bench.runs / "sweep", method="mannequin")
    assert outcome.status == 0, outcome.err
    names = {json.loads(p.read_text())["identity"]["protocol"] for p in (bench.runs / "sweep").glob("*/run.json")}
    assert {name.rpartition("fraction=")[2] for name in names} == {"0.2", "0.6"}
    assert outcome.out.count("## ") >= 2  # never in one table


def test_shares_outside_0_to_1_are_refused(bench):
    for words in (["--occlusion.fraction", "1.2"], ["--occlusion.covers", "-0.1"]):
        outcome = bench.run(*words)
        assert outcome.status == 2
        assert "expected 0 to 1" in outcome.err
    outcome = bench(
        "score", "--protocol", bench.protocol, "--predictions", bench.cache, "--occlusion.fraction", "0.1", "0.2"
    )
    assert outcome.status == 2


def test_the_released_score_stands_beside_the_held_out_one(tmp_path, bench, mannequin, monkeypatch):
    from ihbench.datasets.standin import ocmotion_capture

    for name, value in (("N_FRAMES", 100), ("WIDTH", 96), ("HEIGHT", 72)):
        monkeypatch.setattr(ocmotion_capture, name, value)
    root = ocmotion_capture.OcMotionStandIn.ensure(tmp_path / "oc", 0, ["standin-1"], {})
    words = [
        "run",
        "--full",
        "--protocol",
        "ocmotion_visible",
        "--data",
        root,
        "--runs",
        tmp_path / "runs",
        "--method",
        "mannequin",
    ]
    outcome = bench(*words)
    assert outcome.status == 0, outcome.err
    (folder,) = (p.parent for p in (tmp_path / "runs").glob("*/run.json"))
    rows = read_result(folder).rows
    assert {"mannequin", "mannequin [train = test]"} <= set(rows)
    identity = Identity.parse("psnr/pooled/range1/body/v1")
    assert rows["mannequin"][identity].value != rows["mannequin [train = test]"][identity].value
    assert "| mannequin [train = test] |" in outcome.out
    frames = {(line["row"], line["frame"] % 2) for line in map(json.loads, (folder / "scores.jsonl").open())}
    assert frames == {("mannequin", 1), ("mannequin [train = test]", 0)}


def test_what_is_handed_out_can_be_drawn_and_scored(bench, tmp_path):
    out = bench(
        "prepare",
        "--protocol",
        bench.protocol,
        "--profile",
        "quick",
        "--out",
        tmp_path,
        "--scene",
        "standin-1",
        "--json",
    )
    assert out.status == 0, out.err
    told = json.loads(out.out)
    assert told["layout"] == "zju"
    folder = tmp_path / "standin-1"
    with bench.in_its_world():
        scene = open_scene(*_opened(load_protocol(str(bench.protocol)), None, "standin-1"))
        for row, view in zip(json.loads((folder / "test_views.json").read_text()), scene.test, strict=True):
            write_png(tmp_path / "drawn" / row["prediction"], np.rint(view.image * 255).astype(np.uint8))
    scored = bench(
        "score",
        "--protocol",
        bench.protocol,
        "--predictions",
        tmp_path / "drawn",
        "--runs",
        tmp_path / "runs",
        "--json",
    )
    assert scored.status == 0, scored.err
    scores = json.loads(scored.out)["runs"][0]["scores"]["drawn"]
    assert scores["ssim/gauss11-1.5/range1/body/v1"] == 1.0
    again = bench(
        "prepare", "--protocol", bench.protocol, "--profile", "quick", "--out", tmp_path, "--scene", "standin-1"
    )
    assert again.status == 2
    assert "is there already" in again.err


@pytest.mark.parametrize(
    ("files", "gender", "chosen"),
    [
        (["SMPL_FEMALE.pkl", "SMPL_MALE.pkl", "SMPL_NEUTRAL.pkl"], "female", "SMPL_FEMALE.pkl"),
        (["SMPL_MALE.pkl", "SMPL_NEUTRAL.pkl"], "female", "SMPL_NEUTRAL.pkl"),
        (["basicModel_f_lbs_10_207_0_v1.0.0.pkl", "basicmodel_m_lbs_10_207_0_v1.0.0.pkl"], "male", "basicmodel_m"),
        (["notes.txt"], "male", None),
    ],
)
def test_a_folder_of_body_files_has_one_for_each_gender(tmp_path, files, gender, chosen):
    for name in files:
        (tmp_path / name).write_bytes(b"")
    if chosen is None:
        with pytest.raises(BadInput, match=r"expected SMPL_MALE\.pkl"):
            body_file(tmp_path, gender)
    else:
        assert body_file(tmp_path, gender).name.startswith(chosen)
    assert body_file(tmp_path / files[0], gender) == tmp_path / files[0]


def test_a_large_capture_opens_without_decoding_an_image(tmp_path, monkeypatch):
    """646 frames of 23 cameras: headers only, whatever the number of images."""
    from ihbench.datasets.layouts import ZJU_MOCAP
    from ihbench.datasets.zju_mocap import original as zju_mocap
    from ihbench.files import pictures

    folder = tmp_path / "CoreView_386"
    cameras = [a_camera(0.27 * k) for k in range(23)]
    zju_mocap.write_annots(folder, cameras, zju_mocap.standard_image_paths(23, 646))
    (folder / "new_params").mkdir()
    read = []
    monkeypatch.setattr(pictures, "_opened", lambda path, _: read.append(path))
    capture = ZJU_MOCAP(tmp_path).open("386")
    assert (capture.n_frames, len(capture.camera_ids)) == (646, 23)
    assert capture.image_path(22, 645).name == "000645.jpg"
    assert read == []


def test_another_image_size_is_the_same_protocol_but_for_its_images():
    protocol = load_protocol("zju_occ")
    small = protocol.with_fields({"image.size": 64})
    assert (small.image.size, small.name) == (64, f"{protocol.name}+size=64")
    assert small.digest != protocol.digest
    assert small.with_fields({"image.size": 256}).digest == protocol.digest
    assert protocol.with_fields({}) is protocol.with_fields({"image.size": 256}) is protocol
    assert small.with_fields({"occlusion.rule": "none"}).name == f"{protocol.name}+size=64+occlusion=none"
    for bad in (7, 8193):
        with pytest.raises(BadInput, match=r"--protocol\.image\.size: expected"):
            protocol.with_fields({"image.size": bad})
