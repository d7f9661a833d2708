"""The site of some runs, read without a browser: its numbers, its pictures, its policy, what travels of an avatar."""

import http.client
import io
import json
import shutil
import threading
import tomllib
import zlib
from dataclasses import replace
from http.server import ThreadingHTTPServer
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from ihbench import registry
from ihbench.body import load_body
from ihbench.body.pose import BodyPose
from ihbench.body.uv import texel_table
from ihbench.camera import Camera, look_at
from ihbench.clock.checkpoints import States
from ihbench.clock.events import LeftOut, Warned
from ihbench.clock.progress import Progress
from ihbench.errors import BadInput
from ihbench.files.pictures import read_rgb
from ihbench.record.finished_run import FinishedRun
from ihbench.record.results import read_result, summary
from ihbench.record.schema import score_lines
from ihbench.record.shareable import without_places
from ihbench.record.store import RunFolder
from ihbench.render.spherical_harmonics import colors_of
from ihbench.reports.site import avatars, baking, build, corrections, moving, painted, tables
from ihbench.reports.site.frames import REGIONS, Files, OpenScenes
from ihbench.reports.site.server import Followed, handler, own_port
from ihbench.scene.mask_state import MaskState
from ihbench.scene.protocol import load_protocol
from ihbench.scene.sightings import FINE
from ihbench.scoring.scoring import Scorer
from ihbench.show.subject import Subject
from tests.reports import fake_runs, made_up_runs
from tests.reports.site_reading import Page, Plates, sha256, unpacked, value

HOSTILE = "<img src=x onerror=\"document.title='taken'\">&</script><script>alert(1)</script>"


@pytest.fixture(scope="module")
def results(finished, tmp_path_factory):
    """A run, and the same again under a name that means harm."""
    other = tmp_path_factory.mktemp("runs") / finished.folder.name
    shutil.copytree(finished.folder, other)
    record = json.loads((other / "run.json").read_text())
    record["about"]["label"] = HOSTILE
    (other / "run.json").write_text(json.dumps(record))
    return [read_result(finished.folder), read_result(other)]


@pytest.fixture(scope="module")
def site(studio, results):
    with studio.in_its_world():
        return build.build(results, ["a folder: was damaged"], views=3)


@pytest.fixture(scope="module")
def page(site):
    return Page(site.html(single=True))


def test_every_number_is_the_runs_own(page, results):
    data = page.data
    for shown, run, words in zip(data["runs"], results, summary(results)["runs"], strict=True):
        lines = score_lines(run.folder / "scores.jsonl")
        assert [(v["camera"], v["frame"]) for v in shown["views"]] == [(str(x.camera), x.frame) for x in lines]
        compared = 0
        for view, line in zip(shown["views"], lines, strict=True):
            for name, score in zip(shown["identities"], view["scores"], strict=True):
                number = {str(i): v for i, v in line.scores.items()}[name]
                expected = without_places(line.absent[name]) if np.isnan(number) else number
                assert value(score, shown["reasons"]) == expected
                compared += 1
        assert compared == len(lines) * len(run.own) > 20
        means = words["scores"][run.method]
        for name, mean in zip(shown["identities"], shown["means"], strict=True):
            assert (mean if mean is not None else "nan") == means[name]
    (group,) = data["groups"]
    for row in group["rows"]:
        if row["kind"] == "bound":
            assert row["means"] == {i: m for i, m in words["scores"][row["row"]].items() if i in row["means"]}
            continue
        (k,) = row["runs"]
        own = dict(zip(data["runs"][k]["identities"], data["runs"][k]["means"], strict=True))
        assert row["means"]
        assert all(own[name] == mean for name, mean in row["means"].items())
    assert [row["label"] for row in group["rows"][:2]] == [data["runs"][0]["label"], HOSTILE]
    assert group["standin"]
    assert group["headline"] == "body"
    assert any("lpips" in name for name in group["absent"])
    assert tomllib.loads(group["toml"])["occlusion"]["rule"] == results[0].about.protocol["occlusion"]["rule"]
    assert data["left_out"] == ["a folder: was damaged"]


def test_methods_with_other_scenes_are_compared_over_what_all_have():
    scores = {
        ("a", "ours"): 20.0,
        ("b", "ours"): 22.0,
        ("c", "ours"): 40.0,
        ("a", "other"): 21.0,
        ("b", "other"): 23.0,
    }
    runs = [fake_runs.fake_run(scene, method, psnr=psnr) for (scene, method), psnr in scores.items()]
    (group,) = tables.site_tables(runs)["groups"]
    assert group["common"] == ["a", "b"]
    rows = {row["label"]: row for row in group["rows"]}
    name = next(i["name"] for i in group["identities"] if i["metric"] == "psnr")
    assert [rows[m]["means"][name] for m in ("ours", "other")] == pytest.approx([82 / 3, 22.0])
    assert [rows[m]["common"][name] for m in ("ours", "other")] == pytest.approx([21.0, 22.0])
    assert rows["ours"]["scenes"] == ["a", "b", "c"]
    assert [rows[m]["marks"].get(name) for m in ("ours", "other")] == [None, "best"]  # of what both have
    assert tables.site_tables(runs[:2] + runs[3:])["groups"][0]["common"] is None
    assert tables.site_tables([runs[2], *runs[3:]])["groups"][0]["common"] == []


def test_what_a_protocol_says_survives_as_toml():
    content = {
        "title": 'a "quoted" \\ line\nof two', "size": 3, "share": 0.5, "on": True, "nothing": [],
        "of": {"rows": [1, [2, "x"]], "deeper": {"odd key!": "é", "empty": {}}}, "late": "\t\r\x7f",
        "several": [{"a b": 1, "c": {"d": [True]}}, {}],
    }  # fmt: skip
    assert tomllib.loads(tables.toml(content)) == content


@pytest.mark.parametrize("name", registry.names("protocol"))
def test_every_shipped_protocol_survives_as_toml(name):
    content = json.loads(json.dumps(load_protocol(name, "quick").content))  # as a record has it
    assert tomllib.loads(tables.toml(content)) == content


def test_what_a_run_says_of_itself_is_told_by_kind():
    run = fake_runs.with_events(fake_runs.fake_run(), LeftOut("lpips term", "no weights"), Warned("again"))
    said = tables.site_tables([run, fake_runs.fake_run("b")])["runs"]
    assert said[0]["remarks"] == {"left out by the fit": ["lpips term: no weights"], "warning": ["again"]}
    assert said[1]["remarks"] == {}


def test_a_run_that_failed_has_a_curve_alone(tmp_path):
    """Everything that a page shows of it has its metric's title and unit."""
    run = made_up_runs.made_up(tmp_path)
    outcome = replace(run.record.outcome, status="diverged", reason="lost")
    run = replace(run, record=replace(run.record, outcome=outcome), rows={})
    data = tables.site_tables([run])
    named = {name.split("/")[0] for point in data["runs"][0]["curve"] for name in point["scores"]}
    assert named == {"psnr", "flip"} == set(data["metrics"])
    assert data["groups"][0]["identities"] == []


def test_numbers_of_different_identity_never_share_a_column():
    one, other = (fake_runs.fake_run(scene, method) for scene, method in (("a", "ours"), ("a", "theirs")))
    psnr = fake_runs.PSNR.format("body")
    later = psnr.removesuffix("v1") + "v2"
    scores = {i: mean for i, mean in other.own.items() if str(i) != psnr} | fake_runs.mean(later, 40.0)
    (group,) = tables.site_tables([one, replace(other, rows={"theirs": scores})])["groups"]
    assert {psnr, later} <= {column["name"] for column in group["identities"]}
    ours, theirs = group["rows"][:2]
    assert psnr in ours["means"].keys() - theirs["means"].keys()
    assert later in theirs["means"].keys() - ours["means"].keys()
    assert not {psnr, later} & {*ours["marks"], *theirs["marks"]}  # nothing to compare with


def test_a_script_comes_before_what_a_page_carries(site):
    """So that it draws before megabytes of pictures are read."""
    order = list(Page(site.html(single=True)).inside)
    assert order.index("data") < order.index("script") < min(k for k, name in enumerate(order) if "file-" in name)


def test_marks_need_intervals():
    def row(label, values):
        return [fake_runs.fake_run(scene, label, psnr=value, ssim=0.9) for scene, value in values.items()]

    apart = row("good", {"a": 30.0, "b": 30.1, "c": 29.9}) + row("bad", {"a": 20.0, "b": 20.2, "c": 19.9})
    rows = tables.site_tables(apart)["groups"][0]["rows"]
    psnr = fake_runs.PSNR.format("body")
    assert [row["marks"].get(psnr) for row in rows[:2]] == ["best", None]
    assert rows[0]["intervals"][psnr][0] < 30.0 < rows[0]["intervals"][psnr][1]
    near = row("good", {"a": 30.0, "b": 20.0, "c": 25.0}) + row("bad", {"a": 20.0, "b": 30.0, "c": 24.0})
    assert [r["marks"] for r in tables.site_tables(near)["groups"][0]["rows"][:2]] == [{}, {}]


def test_nothing_but_the_pages_own_script_may_run(site, page):
    rules = page.policy
    assert rules["default-src"] == rules["connect-src"] == rules["base-uri"] == rules["form-action"] == "'none'"
    assert rules["script-src"] == sha256(page.inside["script"])
    assert rules["style-src"] == sha256(page.inside["style"])
    assert rules["require-trusted-types-for"] == "'script'"
    assert not [t for t, a in page.tags if any(name.startswith("on") or name == "style" for name in a)]
    runs = [a for t, a in page.tags if t == "script" and a.get("type") not in ("application/json", "text/plain")]
    assert runs == [{}]
    addresses = [a[name] for _, a in page.tags for name in ("src", "href", "action") if name in a]
    assert addresses == ["data:,"]
    script = page.inside["script"].replace("http://www.w3.org/2000/svg", "")
    sinks = ("innerHTML", "outerHTML", "insertAdjacent", "document.write", "eval(", "http")
    assert not [word for word in sinks if word in script]


def test_a_name_that_means_harm_is_text(site, page):
    assert page.data["runs"][1]["label"] == HOSTILE
    assert not [t for t, _ in page.tags if t == "img"]
    assert HOSTILE not in site.html()
    assert "alert(1)</script" not in site.html()
    with_title = Page(build.Site(HOSTILE, site.data).html())
    assert [t for t, _ in with_title.tags].count("script") == 2  # data and script
    assert not [t for t, _ in with_title.tags if t == "img"]


def test_pictures_are_what_was_scored(studio, site, results, finished):
    (scene,) = site.data["frames"]
    assert scene["reason"] == ""
    assert len(scene["views"]) >= 3

    def pixels(name):
        return Image.open(io.BytesIO(site.files[name]))

    with studio.in_its_world():
        opened = FinishedRun(finished.folder).scene
        scorer = Scorer.build(opened)
        keys = {(key.camera_id, key.frame): k for k, key in enumerate(opened.test_keys)}
        for view in scene["views"]:
            loaded = scorer.load(keys[view["camera"], view["frame"]])
            stored = read_rgb(finished.folder / "renders" / view["camera"] / f"{view['frame']:06d}.png")
            assert np.array_equal(np.asarray(pixels(view["predictions"]["0"]).convert("RGB")), stored)
            truth = np.asarray(pixels(view["truth"]).convert("RGB"))
            assert np.array_equal(truth, np.rint(loaded.view.image * 255))
            for name, region in loaded.regions.items():
                if name in REGIONS and region.any():
                    drawn = np.asarray(pixels(view["masks"][name]).convert("RGBA"))
                    assert np.array_equal(drawn[..., 3] > 0, region)
                    assert (drawn[region] == (*REGIONS[name], 255)).all()
            left, top, right, bottom = view["window"]
            assert not loaded.view.silhouette[:top].any()
            assert not loaded.view.silhouette[:, :left].any()
            assert not loaded.view.silhouette[bottom:].any()
            assert not loaded.view.silhouette[:, right:].any()
    run = results[0]
    psnr = next(i for i in run.own if i.region == "hidden" and i.metric == "psnr")
    lines = [x for x in score_lines(run.folder / "scores.jsonl") if np.isfinite(x.scores[psnr])]
    worst = min(lines, key=lambda x: x.scores[psnr])
    assert (str(worst.camera), worst.frame) in {(v["camera"], v["frame"]) for v in scene["views"]}


def test_without_the_data_there_are_predictions_and_the_reason(results, tmp_path, monkeypatch):
    monkeypatch.setenv("IHBENCH_CACHE", str(tmp_path))  # a stand-in of another seed's place: nothing there
    monkeypatch.setattr(FinishedRun, "capture", property(lambda self: (_ for _ in ()).throw(BadInput("is gone"))))
    site = build.build(results[:1], views=2)
    (scene,) = site.data["frames"]
    assert scene["reason"] == "is gone"
    assert len(scene["views"]) == 2
    assert all(v["predictions"] and "truth" not in v for v in scene["views"])
    about = site.data["avatars"]["0"]
    assert about["reason"] == ""
    assert set(about["labels"].values()) == {0.0}


def test_an_avatar_travels(studio, site, finished):
    about = site.data["avatars"]["0"]
    assert about["reason"] == ""
    assert len(about["turntable"]) > 5
    own, skin = site.carried[about["own"]], site.carried[about["skin"]]
    found = unpacked(own, skin, about)
    with studio.in_its_world():
        run = FinishedRun(finished.folder)
        subject, scene = Subject(run), run.scene
        poses = [scene.train[k].body_pose for k in range(3)]
        baked = baking.bake(subject, poses, scene.training.sightings[FINE].visibility).avatar
        again = unpacked(*baked.packed(), baked.about)
        for name, values in again.items():
            assert np.allclose(values, getattr(baked, name), atol=1e-9), name
        assert found["rest"].shape == again["rest"].shape
        assert (found["weights"].sum(1) == 255).all()
        part = found["labels"] & 3
        shares = [float(np.mean(part == label)) for label in (1, 2, 3)]
        assert shares == [about["labels"][name] for name in ("visible", "hidden", "never_seen")]
        assert min(shares) > 0.01
        assert sum(shares) == pytest.approx(1)
        pose = scene.test[0].body_pose
        means, scales, colours = (v.numpy() for v in subject.avatar.gaussians(pose))
        assert np.abs(baked.means(subject.body, pose) - means).max() < 5e-3
        assert np.abs(np.log(baked.scales / scales)).max() < 0.05
        assert np.abs(baked.colours / 255 - np.clip(colours, 0, 1)).max() < 0.05
        named = f"{scene.test_keys[0].camera_id}/{scene.test_keys[0].frame}"
        paid = avatars.price(baked, subject, scene.test[0].camera, pose, (1.0, 1.0, 1.0))
    assert paid.psnr > 35
    assert paid.iou > 0.99
    prices = about["price"]
    assert named in prices
    assert all(psnr == "inf" or psnr > 35 for psnr, _ in prices.values())
    assert any(name.startswith("motion ") for name in prices)
    assert {"march", "lunge", "bow", "turn"} <= set(site.data["motions"]["shared"])


def test_a_price_is_paid_for_what_was_changed(studio, finished):
    """Moved by 2 cm, the avatar is no longer the same."""
    with studio.in_its_world():
        run = FinishedRun(finished.folder)
        subject, view = Subject(run), run.scene.test[0]
        baked = baking.bake(subject, [view.body_pose], None).avatar
        object.__setattr__(baked, "rest", baked.rest + 0.02)
        paid = avatars.price(baked, subject, view.camera, view.body_pose, (1.0, 1.0, 1.0))
    assert paid.psnr < 30
    assert paid.iou < 0.97


def test_general_gaussians_come_back_from_any_pose():
    body, betas = load_body(), np.zeros(10)
    rng = np.random.default_rng(1)
    poses = [BodyPose(0.3 * rng.normal(size=(24, 3)), betas, rng.normal(size=3)) for _ in range(3)]
    plates = Plates(body, betas)
    subject = SimpleNamespace(avatar=plates, body=body, betas=betas)
    baked = baking.bake(subject, poses, None).avatar  # type: ignore[arg-type]
    found = unpacked(*baked.packed(), baked.about)
    for name, values in found.items():
        assert np.allclose(values, getattr(baked, name), atol=1e-9), name
    far = np.abs(baked.rest - plates.rest).max(1)  # weights may be those of a neighbouring point
    assert np.median(far) < 2e-3
    assert np.quantile(far, 0.95) < 0.02
    factors = avatars.axes_of(baked.turns) * baked.scales[:, None, :]
    expected = plates.factors @ plates.factors.transpose(0, 2, 1)
    error = np.abs(factors @ factors.transpose(0, 2, 1) - expected).max((1, 2)) / np.abs(expected).max((1, 2))
    assert np.median(error) < 0.02
    assert np.abs(baked.opacities / 255 - plates.opacities).max() < 0.003


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colours_of_all_directions_travel(degree):
    """As the bench's renderer sees them; and harmonics that nobody would see stay at home."""
    body, pose = load_body(), BodyPose(np.zeros((24, 3)), np.zeros(10), np.zeros(3))
    plates = Plates(body, pose.betas, degree=degree, told=True)
    subject = SimpleNamespace(avatar=plates, body=body, betas=pose.betas)
    baked = baking.bake(subject, [pose], None).avatar  # type: ignore[arg-type]
    found = unpacked(*baked.packed(), baked.about)
    assert baked.degree == degree
    assert ("harmonics" in found) == (degree > 0)
    for name, values in found.items():
        assert np.allclose(values, getattr(baked, name), atol=1e-9), name
    center = np.array([1.0, 2.0, 3.0])
    ours, theirs = (
        colors_of(torch.from_numpy(colours), torch.from_numpy(plates.rest), torch.from_numpy(center), degree).numpy()
        for colours in (baked.shades.reshape(len(baked), -1, 3) if degree else _flat(baked), plates.colours)
    )
    assert np.sqrt(np.mean((ours - theirs) ** 2)) < 0.012
    if degree == 3:
        plates.colours[:, 1:] *= 0.01
        plates.colours[:, 4:] = 0
        assert baking.bake(subject, [pose], None).avatar.degree == 0  # type: ignore[arg-type]


def _flat(baked):
    return (baked.shades[:, None] - 0.5) / 0.28209479177387814


def test_what_a_method_does_to_joints_itself_travels():
    """Without corrections the page's avatar holds its arms as the body does, not as the method does."""
    body, betas = load_body(), np.zeros(10)
    rng = np.random.default_rng(2)
    plates = Plates(body, betas, told=True, learned=True)
    subject = SimpleNamespace(avatar=plates, body=body, betas=betas)
    poses = [BodyPose(0.3 * rng.normal(size=(24, 3)), betas, rng.normal(size=3)) for _ in range(6)]
    made = baking.bake(subject, poses, None)  # type: ignore[arg-type]
    assert not isinstance(made, str)
    assert made.corrections is not None
    new = BodyPose(0.3 * rng.normal(size=(24, 3)), betas, rng.normal(size=3))
    kept = corrections.Corrections.of({"one": made.corrections(new)[None], "two": np.zeros((3, 24, 3, 4))})
    theirs = plates.posed_gaussians(new).means.numpy()
    missed = [np.sqrt(((made.avatar.means(body, new, c) - theirs) ** 2).sum(1)) for c in (None, kept.at("one"))]
    assert missed[0].max() > 0.03
    assert missed[1].max() < 0.005  # four weights are kept
    assert missed[1].mean() < 0.0002
    plates.learned = False
    assert baking.bake(subject, poses, None).corrections is None  # type: ignore[union-attr, arg-type]


def test_corrections_lie_on_lines_between_samples():
    one = np.tile(np.eye(3, 4), (24, 1, 1))
    values = np.stack([one, one + 0.2, one - 0.1])
    kept = corrections.Corrections.of({"a": one[None] + 0.4, "b": values})
    assert kept.clips == {"a": (0, 1), "b": (1, 3)}
    for frame, expected in ((0, 0.0), (1, 0.1), (2, 0.2), (3, 0.05), (4, -0.1), (9, -0.1)):
        assert np.allclose(kept.at("b", frame), one + expected, atol=2e-5), frame
    assert np.allclose(kept.at("a", 1), one + 0.4, atol=2e-5)
    assert corrections.samples_of(5, cyclic=True) == [0, 2, 4, 1]
    assert corrections.samples_of(5, cyclic=False) == [0, 2, 4, 4]
    planes = np.frombuffer(zlib.decompress(kept.packed(), -15), np.uint8).astype(np.uint16)
    low, high = planes[: len(planes) // 2], planes[len(planes) // 2 :]
    levels = np.cumsum(low + 256 * high, dtype=np.uint16).view(np.int16).reshape(-1, 4).T
    assert np.array_equal(levels.reshape(4, 24, 3, 4), kept.levels)


def test_what_cannot_be_skinned_says_so():
    subject = SimpleNamespace(avatar=SimpleNamespace(), body=load_body(), betas=np.zeros(10))
    assert "no Gaussians" in baking.bake(subject, [], None)  # type: ignore[arg-type]


def test_one_avatar_does_not_take_the_page_along(results, monkeypatch):
    def fails(run, *_):
        raise RuntimeError("a leg fell off\nand rolled away") if run is results[0] else BadInput("not on this body")

    monkeypatch.setattr(moving, "_avatar", fails)
    made, carried = moving.avatars(results, [], Files(), OpenScenes(None, None), Progress())
    reasons = [about["reason"] for about in made["avatars"].values()]
    assert reasons == ["RuntimeError: a leg fell off and rolled away", "not on this body"]
    assert carried == {}


def test_a_licensed_body_is_shown_in_pictures_alone(studio, results, monkeypatch):
    monkeypatch.setattr(moving, "PROCEDURAL", "another")
    files = Files()
    with studio.in_its_world():
        made, carried = moving.avatars(results[:1], [], files, OpenScenes(None, None), Progress(), share=True)
    (about,) = made["avatars"].values()
    assert "--share" in about["reason"]
    assert carried == {}
    assert set(about["turntable"]) <= set(files.content)
    assert len(about["turntable"]) > 3


def test_painted_surface_is_what_painted_pixels_show(tmp_path):
    body, pose = load_body(), BodyPose(np.zeros((24, 3)), np.zeros(10), np.zeros(3))
    R, t = look_at(np.array([0, 0, 3.0]), np.zeros(3))
    camera = Camera(np.array([[60.0, 0, 32], [0, 60, 32], [0, 0, 1]]), R, t, 64, 64)
    mask = np.full((64, 64), MaskState.PERSON, np.uint8)
    made = np.zeros((64, 64), np.uint8)
    made[:, :32] = 1  # the left half of the picture, which is the person's right
    tensors = {"mask": mask, "generated": made, "K": camera.K, "R": R, "t": t}
    tensors |= {"pose": pose.pose, "betas": pose.betas, "transl": pose.transl}
    folder = tmp_path / "run"
    States(folder).save(painted.STATE, {f"0.{name}": value for name, value in tensors.items()}, {})
    texels = texel_table(body, 64)
    counts = painted.painted_counts(folder, body, texels)
    places = texels.interpolate(body.pose(pose), body.faces)
    assert counts is not None
    assert counts.max() == 1
    assert 0.1 < counts.mean() < 0.4
    assert (places[counts > 0, 0] < 0.03).all()
    assert (places[counts > 0, 2] > -0.2).all()
    assert painted.painted_counts(tmp_path / "none", body, texels) is None
    (folder / "checkpoints" / f"{painted.STATE}.safetensors").write_bytes(b"not that")
    assert painted.painted_counts(folder, body, texels) is None


def test_a_folder_keeps_what_is_somebody_elses(site, tmp_path):
    index = build.write_folder(site, tmp_path / "new")
    assert {f.name for f in (index.parent / "files").iterdir() if f.name[0] != "."} == set(site.files)
    assert build.write_folder(site, tmp_path / "new") == index  # over its own
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs" / "index.html").write_text("mine")
    with pytest.raises(BadInput, match="not as ihbench wrote it"):
        build.write_folder(site, tmp_path / "theirs")
    assert (tmp_path / "theirs" / "index.html").read_text() == "mine"
    names = {name for name in Page(index.read_text()).inside if name.startswith("file-")}
    assert names == {f"file-{name}" for name in site.carried}  # pictures lie beside it, avatars do not


def test_pictures_of_an_earlier_site_go(site, tmp_path):
    files = build.write_folder(site, tmp_path).parent / "files"
    names = sorted(site.files)
    (files / names[0]).write_bytes(b"edited by its user")
    (files / "0123456789abcdef.webp").write_bytes(b"a user's, whose name looks like ours")
    (files / "notes.txt").write_text("a user's")
    other = replace(site, files={name: site.files[name] for name in names[3:]})
    build.write_folder(other, tmp_path)
    left = {file.name for file in files.iterdir() if not file.name.startswith(".")}
    assert left == {names[0], "0123456789abcdef.webp", "notes.txt", *names[3:]}


def test_one_file_has_a_limit(site, tmp_path, monkeypatch):
    assert build.write_single(site, tmp_path / "one.html") == (tmp_path / "one.html").stat().st_size
    monkeypatch.setattr(build, "LARGEST_FILE", 1000)
    with pytest.raises(BadInput, match="--views"):
        build.write_single(site, tmp_path / "two.html")
    assert not (tmp_path / "two.html").exists()


def test_the_command(bench, finished, tmp_path, monkeypatch):
    monkeypatch.setattr(
        build, "build", lambda results, left_out, **more: build.Site("t", {"n": len(results), **more})
    )
    done = bench("site", finished.folder, finished.folder.parent, "--out", tmp_path / "a", "--views", "5")
    assert done.status == 0, done.err
    assert f"{tmp_path / 'a' / 'index.html'}: 1 run;" in done.out
    data = Page((tmp_path / "a" / "index.html").read_text()).data
    assert (data["n"], data["views"], data["share"]) == (1, 5, False)
    done = bench("site", finished.folder, "--single-file", "--out", tmp_path / "b.html")
    assert done.status == 0
    assert (tmp_path / "b.html").is_file()
    for words in (
        ("site", tmp_path / "none"),
        ("view", tmp_path / "none"),
        ("site", finished.folder, "--views", "0"),
        ("site", finished.folder, "--out", tmp_path / "b.html"),  # a file, or the name of one
        ("site", finished.folder, "--out", tmp_path / "c.html"),
    ):
        refused = bench(*words)
        assert (refused.status, refused.err.count("\n")) == (2, 1), refused.err


@pytest.fixture
def served(results, tmp_path):
    """A server of a finished run and one that is running, without a thread that follows."""
    running = RunFolder.create(tmp_path, fake_runs.identity("a", "slow"), fake_runs.about())
    (running.path / "curve.jsonl").write_text(
        json.dumps({"step": 7, "seconds": 3.0, "views": 2, "of": 4, "scores": {fake_runs.PSNR.format("body"): 21.5}})
        + "\n"
    )
    with running.lock():
        reads = [results[0], read_result(running.path)]
        made = []

        def make(runs, left_out, pictures):
            made.append(pictures)
            return build.build(runs, left_out, pictures=False)

        followed = Followed(lambda: (reads, []), make)
        followed.look()
        server = ThreadingHTTPServer(("127.0.0.1", 0), handler(followed))
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
        thread.start()
        yield SimpleNamespace(port=own_port(server), followed=followed, reads=reads, made=made, folder=running)
        server.shutdown()
        server.server_close()


def asked(served, path, host=None, method="GET"):
    connection = http.client.HTTPConnection("127.0.0.1", served.port, timeout=10)
    connection.request(method, path, headers={"Host": host or f"127.0.0.1:{served.port}"})
    answer = connection.getresponse()
    content = answer.read()
    connection.close()
    return answer, content


def test_a_served_site(served):
    answer, content = asked(served, "/")
    page = Page(content.decode())
    assert answer.status == 200
    assert page.policy["connect-src"] == "'self'"
    assert answer.headers["Content-Security-Policy"].startswith("default-src 'none'; script-src 'sha256-")
    assert page.data["live"] == {"version": 2}
    assert len(page.data["runs"]) == 2
    state = json.loads(asked(served, "/state")[1])
    (run,) = state["runs"]
    assert run["words"] == "slow on a, seed 0: running, step 7, 3 s of fitting, PSNR body ↑ 21.50"
    assert run["curve"][0]["step"] == 7
    for path, host, method, status in (
        ("/files/../../etc/passwd", None, "GET", 404),
        ("/files/none.webp", None, "GET", 404),
        ("/", f"elsewhere.example:{served.port}", "GET", 421),
        ("/state", "127.0.0.1:1", "GET", 421),
        ("/", None, "POST", 501),
    ):
        assert asked(served, path, host, method)[0].status == status, path


def test_a_site_is_made_anew_when_a_run_has_finished(served):
    assert served.made == [False, True]  # numbers first
    served.followed.look()
    assert served.made == [False, True]
    assert served.followed.version == 2
    served.folder.set_status("failed", "a leg fell off")
    served.reads[1] = read_result(served.folder.path)
    served.followed.look()
    assert served.made == [False, True, True]
    assert served.followed.version == 3
    assert json.loads(asked(served, "/state")[1])["runs"] == []

    def gone():
        raise BadInput("moved away")

    served.followed.read = gone
    served.followed.look()
    assert json.loads(asked(served, "/state")[1])["fault"] == "moved away"
