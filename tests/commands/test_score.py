"""`ihbench score`: folders of renders that somebody else made."""

import json
import shlex
import shutil
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from ihbench.api import load_scene
from ihbench.clock.progress import Progress
from ihbench.data.prepared import read_prepared
from ihbench.errors import BadInput
from ihbench.files import atomic
from ihbench.files.images import read_image
from ihbench.scene.data_source import standin_root
from ihbench.scene.views import TestViewKey, open_scene
from ihbench.scoring.predictions import find_alpha, find_predictions

KEYS = [TestViewKey(c, f, f"cam{c}") for c in (1, 2) for f in (0, 30)]
WHITE = (1.0, 1.0, 1.0)


def picture(path, size=8, value=100):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((size, size, 3), value, np.uint8)).save(path)


@pytest.fixture
def truths(bench, tmp_path):
    """The truth of every test view of standin-1 as PNG files, in the default layout."""
    folder = tmp_path / "mine"
    with bench.in_its_world():
        scene, _ = load_scene(str(bench.protocol), "standin-1", profile="quick")
        for view in scene.test:
            path = folder / view.camera_id / f"{view.frame:06d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(np.rint(view.image * 255).astype(np.uint8)).save(path)
    return folder


def score(bench, folder, *more):
    words = ["score", "--protocol", bench.protocol, "--predictions", folder, "--runs", bench.runs, "--full"]
    return bench(*words, "--scene", "standin-1", "--profile", "quick", *more)


def test_the_truth_is_perfect_in_every_metric_and_region(bench, truths):
    outcome = score(bench, truths, "--json")
    assert outcome.status == 0, outcome.err
    (run,) = json.loads(outcome.out)["runs"]
    assert run["predictions"]["missing"] == run["predictions"]["surplus"] == []
    perfect = {"psnr": "inf", "ssim": 1.0, "flip": 0.0}
    for identity, value in run["scores"]["mine"].items():
        assert value in (perfect.get(identity.partition("/")[0]), "nan"), identity
        assert value != "nan" or identity.startswith("lpips") or run["scores"]["truth"][identity] == "nan"
    record = atomic.read_json(bench.folders()[0] / "run.json")
    assert record["about"]["predictions"]["missing"] == []
    assert (bench.folders()[0] / "contact_sheet.png").is_file()


def test_missing_and_surplus_files_are_reported_and_the_rest_is_scored(bench, truths):
    files = sorted(truths.rglob("*.png"))
    for path in files[:2]:
        path.unlink()
    shutil.copy(files[2], truths / "stray.png")
    outcome = score(bench, truths)
    assert outcome.status == 1
    for path in files[:2]:
        assert f"missing: {path.relative_to(truths)}" in outcome.err
    assert "surplus: stray.png" in outcome.err
    assert f"2 of {len(files)} absent: no prediction of this view" in outcome.out
    mark = f"mine (predictions, only {len(files) - 2} of {len(files)} views)"
    assert outcome.out.count(f"| {mark} |") >= 3
    for words in ([], ["--format", "tex"], ["--format", "html"]):
        assert mark in bench("report", "--runs", bench.runs, *words).out, words
    for kind in ("md", "tex", "html", "csv", "json"):
        assert mark in bench("report", "table1", "--runs", bench.runs, "--format", kind).out, kind
    (run,) = json.loads(score(bench, truths, "--json").out)["runs"]
    assert (run["missing_views"], run["predictions"]["views"]) == (2, len(files))


def test_strays_of_another_size_and_kind_do_not_stop_scoring(bench, truths):
    picture(truths / "0 first.png", size=99)
    (truths / "1 second.png").write_bytes(b"no picture")
    words = ["score", "--protocol", bench.protocol, "--predictions", truths, "--runs", bench.runs, "--full"]
    outcome = bench(*words, "--scene", "standin-1")
    assert outcome.status == 0, outcome.err
    assert "quick profile" in outcome.out
    for name in ("0 first.png", "1 second.png"):
        assert f"surplus: {name}" in outcome.err


def test_an_image_size_needs_no_profile(bench, tmp_path):
    """Which of the profiles is told by the views that have images."""
    words = ["score", "--protocol", bench.protocol, "--predictions", tmp_path / "p", "--runs", bench.runs, "--full"]
    with bench.in_its_world():
        scene, _ = load_scene(str(bench.protocol), "standin-1", profile="quick")
        for key in scene.test_keys:
            picture(tmp_path / "p" / f"{key.name}.png", size=40)
    outcome = bench(*words, "--scene", "standin-1", "--image-size", 40)
    assert outcome.status == 0, outcome.err
    assert "size=40, quick profile" in outcome.out
    outcome = bench(*words, "--scene", "standin-1")
    assert outcome.status == 2
    assert "most are 40 px on their longer side" in outcome.err
    assert "64 px in quick; say otherwise with --image-size" in outcome.err


def test_names_are_printed_without_making_a_stand_in(bench, tmp_path):
    words = [
        "score",
        "--protocol",
        bench.protocol,
        "--predictions",
        tmp_path / "none",
        "--names",
        "--profile",
        "quick",
    ]
    fresh = replace(bench, cache=tmp_path / "cache")
    outcome = fresh(*words)
    assert outcome.status == 0, outcome.err
    assert not fresh.cache.exists()
    with bench.in_its_world():
        scene, _ = load_scene(str(bench.protocol), "standin-1", profile="quick")
    expected = [f"standin-1/{key.name}.png" for key in scene.test_keys]
    assert [line for line in outcome.out.splitlines() if line.startswith("standin-1/")] == expected
    assert json.loads(fresh(*words, "--json", "--scene", "standin-1").out) == {"standin-1": expected}


@pytest.mark.parametrize("own", [False, True])
def test_what_prepare_prints_scores_what_it_handed_out(bench, tmp_path, monkeypatch, own):
    """With changes to the protocol, and data of one's own, which are found again from another folder."""
    changes = ["--protocol", bench.protocol, "--scene", "standin-1", "--profile", "quick", "--image-size", 40]
    changes += ["--train-frames", "0:500:250", "--occlusion.rule", "side"]
    if own:
        with bench.in_its_world():
            changes += ["--data", standin_root("zju_mocap")]
    out = tmp_path / "my sets"
    outcome = bench("prepare", *changes, "--out", out)
    assert outcome.status == 0, outcome.err
    words = shlex.split(outcome.out.splitlines()[-1].partition(": ")[2])
    assert words[:3] == ["ihbench", "score", "--prepared"]
    manifest = atomic.read_json(out / "standin-1" / "manifest.json")
    assert str(tmp_path) not in json.dumps(manifest)
    with bench.in_its_world():
        prepared = read_prepared(out)
        scene = open_scene(prepared.source(None, ()).open("standin-1", None, Progress.silent())[0], prepared.protocol)
        for view, row in zip(scene.test, atomic.read_json(out / "standin-1" / "test_views.json"), strict=True):
            path = tmp_path / "drawn" / row["prediction"]
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(np.rint(view.image * 255).astype(np.uint8)).save(path)
            assert view.image.shape[:2] == (row["height"], row["width"])
    if own:
        file = out / "standin-1" / "manifest.json"
        atomic.write_json(file, manifest | {"data": "../../gone"})
        gone = bench(*words[1:])
        assert (gone.status, "there lay the data that were prepared; name --data" in gone.err) == (2, True)
        atomic.write_json(file, manifest)
    monkeypatch.chdir(tmp_path)
    words[words.index("DIR")] = "drawn"
    outcome = bench(*words[1:], "--runs", bench.runs, "--json")
    assert outcome.status == 0, outcome.err
    (run,) = json.loads(outcome.out)["runs"]
    assert run["scores"]["drawn"]["psnr/pooled/range1/full/v1"] == "inf"
    assert (
        atomic.read_json(bench.folders()[0] / "run.json")["identity"]["protocol_digest"]
        == manifest["protocol_digest"]
    )
    for more, told in (
        (["--image-size", 40], "leave those out"),
        (["--occlusion.rule", "side"], "leave those out"),
        (["--protocol", bench.protocol], "either --protocol"),
        (["--scene", "standin-9"], "was not prepared: "),
    ):
        outcome = bench(*words[1:], *more)
        assert (outcome.status, told in outcome.err) == (2, True), outcome.err


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"protocol_digest": "0"}, "another one to this ihbench"),
        ({"content": {}}, "prepare it again"),
        ({"scene": 3}, "no manifest of `ihbench prepare`"),
        ({"body": "0"}, "was prepared from"),
        (None, "no manifest.json"),
    ],
)
def test_a_manifest_that_does_not_fit_is_refused(bench, tmp_path, change, told):
    words = [
        "--protocol",
        bench.protocol,
        "--scene",
        "standin-1",
        "--profile",
        "quick",
        "--train-frames",
        "0:500:250",
    ]
    assert bench("prepare", *words, "--out", tmp_path / "o").status == 0
    file = tmp_path / "o" / "standin-1" / "manifest.json"
    atomic.write_json(file, atomic.read_json(file) | change) if change else file.unlink()
    outcome = bench("score", "--prepared", tmp_path / "o", "--predictions", tmp_path, "--runs", bench.runs)
    assert outcome.status == 2
    assert told in outcome.err


def test_a_report_shows_a_released_evaluators_numbers_beside_the_headline(bench_with_run):
    bench = bench_with_run
    outcome = bench("report", "--runs", bench.runs, "--preset", "gauhuman", "occnerf")
    assert outcome.status == 0, outcome.err
    assert "### preset gauhuman" in outcome.out
    assert "### PSNR ↑ (dB)" in outcome.out
    (folder,) = bench.folders()
    before = (folder / "presets" / "occnerf.jsonl").read_bytes()
    assert bench("report", "--runs", bench.runs, "--preset", "occnerf").out.count("| inpainthuman") >= 2
    assert (folder / "presets" / "occnerf.jsonl").read_bytes() == before
    assert bench("report", "--runs", bench.runs, "--preset", "gauhumann").status == 2


def test_images_of_another_size_are_refused(bench, truths):
    picture(next(truths.rglob("*.png")), size=7)
    outcome = score(bench, truths)
    assert outcome.status == 2
    assert "has shape (7, 7, 3), expected (64, 64, 3)" in outcome.err


def test_a_calibration_rows_name_is_refused(bench, truths):
    assert score(bench, truths, "--name", "truth").status == 2


# -------------------------------------------------------------------------------------------------- matching


@pytest.mark.parametrize(
    ("pattern", "names"),
    [
        (None, ["cam1/000000.png", "cam1/000030.png"]),
        (None, ["s/cam1/000000.png", "s/cam1/000030.png"]),
        ("c{camera_index:02d}_f{frame}.png", ["c01_f0.png", "c01_f30.png"]),
        ("{index:05d}.png", ["00000.png", "00001.png"]),
    ],
)
def test_patterns(tmp_path, pattern, names):
    for name in names:
        picture(tmp_path / name)
    found = find_predictions(tmp_path, "s", KEYS, pattern)
    assert [path.relative_to(tmp_path).as_posix() for path in found.files.values()] == names
    assert list(found.files) == KEYS[:2]
    assert len(found.missing) == 2


@pytest.mark.parametrize(
    ("pattern", "words"),
    [
        ("{cam}.png", "no placeholder {cam}"),
        ("{frame}.png", "one file for several views"),
        ("../{camera}/{frame}.png", "leads out of the folder"),
        ("/x/{camera}/{frame}.png", "leads out of the folder"),
        ("{camera", "expected"),
        ("{camera:06d}{frame}.png", "camera"),
    ],
)
def test_bad_patterns_are_refused(tmp_path, pattern, words):
    picture(tmp_path / "a.png")
    with pytest.raises(BadInput, match=words):
        find_predictions(tmp_path, "s", KEYS, pattern)


def test_a_folder_without_any_of_the_views_says_what_was_expected_and_found(tmp_path):
    picture(tmp_path / "a.png")
    with pytest.raises(BadInput, match=r"expected .*cam1/000000.png.*found a.png"):
        find_predictions(tmp_path, "s", KEYS)
    with pytest.raises(BadInput, match="no such folder"):
        find_predictions(tmp_path / "none", "s", KEYS)


# --------------------------------------------------------------------------------------------------- reading


def test_transparent_images_are_composited_and_grey_ones_coloured(tmp_path):
    rgba = np.zeros((2, 2, 4), np.uint8)
    rgba[0, 0] = 200, 100, 0, 255
    Image.fromarray(rgba).save(tmp_path / "a.png")
    image = read_image(tmp_path / "a.png", (1.0, 0.5, 0.0))
    np.testing.assert_allclose(image[0, 0] * 255, [200, 100, 0])
    np.testing.assert_allclose(image[1, 1], [1.0, 0.5, 0.0])
    Image.fromarray(np.full((2, 2), 7, np.uint8)).save(tmp_path / "g.png")
    assert (read_image(tmp_path / "g.png", WHITE) == np.full((2, 2, 3), 7, np.uint8)).all()


HALF = np.random.default_rng(0).integers(20, 236, (30, 30))  # alpha
BRIGHT = np.random.default_rng(1).integers(120, 256, (30, 30, 3))


def transparent(kind, background=255):
    """RGBA of bright colours of every transparency, with a frame that is clear."""
    share = HALF[..., None] / 255
    colour = {"straight": BRIGHT, "premultiplied": BRIGHT * share}.get(
        kind, BRIGHT * share + background * (1 - share)
    )
    rgba = np.concatenate([np.rint(colour), HALF[..., None]], 2).astype(np.uint8)
    rgba[0] = (*([0, 0, 0] if kind != "composited" else [background] * 3), 0)
    return rgba


@pytest.mark.parametrize("ending", ["png", "npy"])
@pytest.mark.parametrize("kind", ["straight", "premultiplied", "composited"])
def test_what_the_colours_beside_alpha_are_is_proven_or_asked(tmp_path, kind, ending):
    path, rgba = tmp_path / f"a.{ending}", transparent(kind)
    np.save(path, rgba / np.float32(255)) if ending == "npy" else Image.fromarray(rgba).save(path)
    if kind == "straight":
        assert find_alpha([path], WHITE) == find_alpha([path], WHITE, "straight") == kind
        for other in ("premultiplied", "composited"):
            with pytest.raises(BadInput, match=f"--alpha {other}.*not {other}; expected --alpha straight$"):
                find_alpha([path], WHITE, other)
    else:
        with pytest.raises(BadInput, match=f"may be straight or {kind}; say which with --alpha"):
            find_alpha([path], WHITE)
        assert find_alpha([path], WHITE, kind) == kind
    image = read_image(path, WHITE, kind)
    share = HALF[1:, :, None] / 255
    expected = BRIGHT[1:] / 255 * share + 1 - share
    np.testing.assert_allclose((image / (255 if image.dtype == np.uint8 else 1))[1:], expected, atol=0.003)
    assert (image[0] == image[0].max()).all()
    with pytest.raises(BadInput, match="did you mean 'straight'"):
        find_alpha([path], WHITE, "strait")


def test_alpha_of_nothing_or_all_needs_no_word(tmp_path):
    rgba = np.zeros((4, 4, 4), np.uint8)
    rgba[1:3, 1:3] = 90, 60, 30, 255
    Image.fromarray(rgba).save(tmp_path / "a.png")
    Image.fromarray(rgba[..., :3]).save(tmp_path / "b.png")
    assert find_alpha([tmp_path / "a.png", tmp_path / "b.png"], WHITE) == "straight"


def test_premultiplied_truths_are_perfect_when_that_is_said(bench, truths):
    for path in truths.rglob("*.png"):
        white = np.asarray(Image.open(path)).astype(int)
        alpha = np.where((white == 255).all(2, keepdims=True), 0, 200)  # white shows through
        colour = white - (255 - alpha)
        alpha = np.where((colour < 0).any(2, keepdims=True), 255, alpha)
        rgba = np.concatenate([np.where(alpha == 255, white, colour), alpha], 2)
        Image.fromarray(rgba.clip(0, 255).astype(np.uint8)).save(path)
    outcome = score(bench, truths)
    assert outcome.status == 2
    assert "say which with --alpha" in outcome.err
    assert not bench.folders()
    outcome = score(bench, truths, "--alpha", "premultiplied", "--json")
    assert outcome.status == 0, outcome.err
    (run,) = json.loads(outcome.out)["runs"]
    assert float(run["scores"]["mine"]["psnr/pooled/range1/full/v1"]) > 60
    assert run["predictions"]["alpha"] == "premultiplied"
    assert "colours of transparent pixels are premultiplied" in outcome.err
    straight = score(bench, truths, "--alpha", "straight", "--json")
    (other,) = json.loads(straight.out)["runs"]
    assert other["folder"] != run["folder"]
    assert float(other["scores"]["mine"]["psnr/pooled/range1/full/v1"]) < 40


def test_doubts_and_kinds_of_files_are_said(bench, truths):
    for path in truths.rglob("*.png"):
        Image.fromarray(np.asarray(Image.open(path))[..., ::-1].copy()).save(path, "JPEG", quality=95)
    outcome = score(bench, truths)
    assert outcome.status == 0, outcome.err
    for words in ("are JPEG or the like", "red and blue exchanged: are they BGR?"):
        assert words in outcome.err
        assert words in outcome.out
    again = score(bench, truths)
    assert "are they BGR?" in again.err
    assert len(bench.folders()) == 1


def test_sixteen_bits_and_arrays_keep_their_precision(tmp_path):
    import cv2

    deep = np.full((2, 2, 3), (1000, 2000, 3000), np.uint16)  # blue, green, red as OpenCV writes
    cv2.imwrite(str(tmp_path / "d.png"), deep)
    np.testing.assert_allclose(read_image(tmp_path / "d.png", WHITE)[0, 0] * 65535, [3000, 2000, 1000], rtol=1e-6)
    np.save(tmp_path / "f.npy", np.full((2, 2, 3), 1.5, np.float32))
    assert read_image(tmp_path / "f.npy", WHITE).max() == 1.5


@pytest.mark.parametrize("content", [b"", b"\x89PNG\r\n\x1a\n cut", b"\x93NUMPY"])
@pytest.mark.parametrize("name", ["a.png", "a.npy"])
def test_damaged_files_are_named(tmp_path, content, name):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(BadInput, match=rf"prediction .*{name}: (cannot be read|not a numpy)"):
        read_image(tmp_path / name, WHITE)


def test_a_pickled_array_is_refused(tmp_path):
    np.save(tmp_path / "p.npy", np.array([{"a": 1}], object), allow_pickle=True)
    with pytest.raises(BadInput, match="got object"):
        read_image(tmp_path / "p.npy", WHITE)


def test_a_run_that_is_found_again_says_what_is_surplus_now(bench, truths):
    asked = lambda: json.loads(score(bench, truths, "--json").out)["runs"][0]  # noqa: E731
    first, some = asked(), sorted(truths.rglob("*.png"))[0]
    stray = truths / "left behind.png"
    shutil.copy(some, stray)
    again = asked()
    assert again["folder"] == first["folder"]  # nothing was scored anew
    assert (first["predictions"]["surplus"], again["predictions"]["surplus"]) == ([], ["left behind.png"])
    stray.unlink()
    assert asked()["predictions"]["surplus"] == []
