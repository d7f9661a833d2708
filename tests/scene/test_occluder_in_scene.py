"""An occluder that stands in the scene: never known background in training, in no region of a test view."""

import json
from dataclasses import replace
from importlib.metadata import EntryPoint

import numpy as np
import pytest
from PIL import Image

from ihbench import registry
from ihbench.body import write_body
from ihbench.camera import distort
from ihbench.datasets.plain import plain_scene
from ihbench.errors import BadInput
from ihbench.metrics.identity import METRICS
from ihbench.scene.contracts import MaskState
from ihbench.scene.occlusion import Occlusion, occluder
from ihbench.scene.protocol import load_protocol, protocol_from, read_protocol
from ihbench.scene.views import open_scene, uncovered
from ihbench.scoring.scoring import Scorer
from tests.bench.fake_capture import DISTORTION, fake_protocol, rasterized, the_body, turning_capture

PINCUSHION = np.array([0.25, 0.05, 0, 0, 0])
RULE, FRACTION, COVERS = "occlusion.rule", "occlusion.fraction", "occlusion.covers.fraction"
TABLE = slice(45, 62)  # rows of the original image: before the hips
PRESETS = (
    "ihbench",
    "occnerf",
    "gauhuman",
    "humannerf",
    "neuralbody",
    "instantavatar",
    "gtu-mask",
    "3dgs-avatar-zju",
)


def behind_a_table(distortion=None, transl=(0.0, 0.0, 0.0)):
    """The turning person, before whose hips a table stands in every image of every camera."""

    def image(camera, frame, pixels):
        pixels[TABLE] = (150, 75, 0)
        return pixels

    def silhouette(camera, frame, pixels):
        pixels[TABLE] = False
        return pixels

    whole = turning_capture(6, distortion=distortion)
    poses = [replace(pose, transl=pose.transl + transl) for pose in whole.poses]
    whole = replace(whole, poses=poses, cameras=whole.cameras[:2])
    return whole, replace(whole, edit_image=image, edit_silhouette=silhouette)


def natural(base="custom_occ", size=48, **changed):
    protocol = fake_protocol(base, 6, size, "natural")
    return replace(protocol, image=replace(protocol.image, **changed))


@occluder(in_scene=True, takes_fraction=False)
def a_curtain(request):
    """A third party's rule: everything that is not the visible person may be person."""
    return Occlusion("curtain", lambda frame: ~request.silhouette(frame), {})


@pytest.fixture
def curtain(monkeypatch):
    found, point = registry._found, EntryPoint("curtain", f"{__name__}:a_curtain", registry.GROUPS["occlusion"])
    monkeypatch.setattr(
        registry, "_found", lambda kind: found(kind) | ({"curtain": point} if kind == "occlusion" else {})
    )
    return "curtain"


# ------------------------------------------------------------------------------------------------ training


@pytest.mark.parametrize("size", [150, 96, 48, 40])
@pytest.mark.parametrize("base", ["custom_occ", "zju_occ_occnerf", "people_snapshot"])  # area, lanczos4, linear
@pytest.mark.parametrize("distortion", [None, DISTORTION, PINCUSHION], ids=["pinhole", "barrel", "pincushion"])
def test_no_training_pixel_inside_the_body_and_outside_the_mask_is_background(distortion, base, size):
    _, capture = behind_a_table(distortion, (0.3, 0.4, 0.0))  # cut by two borders of the image
    for view in open_scene(capture, natural(base, size)).train:
        body = rasterized(view.camera, view.body_pose).mask
        assert (view.mask[body] != MaskState.BACKGROUND).all(), view.frame
        assert (view.mask[body] == MaskState.UNKNOWN).sum() > 0.05 * body.sum()
        assert (view.mask == MaskState.PERSON).any()
        assert (view.image[view.mask == MaskState.UNKNOWN] == 255).all()


def left_the_photograph(view, capture):
    """[H, W] pixels of the body whose ray ended beside the original image."""
    rows, cols = np.mgrid[: view.camera.height, : view.camera.width] + 0.5
    K, lens = view.camera.K, capture.camera(0)
    x, y = distort((cols - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1], lens.distortion)
    column, row = lens.K[0, 0] * x + lens.K[0, 2], lens.K[1, 1] * y + lens.K[1, 2]
    inside = (column > 0) & (column < lens.width) & (row > 0) & (row < lens.height)
    return rasterized(view.camera, view.body_pose).mask & ~inside


@pytest.mark.parametrize("rule", ["none", "strip-generic", "lower-half", "natural"])
def test_what_a_lens_reaches_beyond_the_photograph_is_not_known(rule):
    whole, _ = behind_a_table(PINCUSHION, (0.5, 0.5, 0.0))
    scene = open_scene(whole, fake_protocol("zju_occ", 6, 96, rule))
    scorer, lost = Scorer.build(scene), 0
    for view in scene.train:
        beyond = left_the_photograph(view, whole)
        lost += beyond.sum()
        assert (view.mask[beyond] == MaskState.UNKNOWN).all()
        assert (view.mask == MaskState.BACKGROUND).mean() > 0.1  # where nobody can be, it stays known
    assert lost > 20
    loaded = scorer.load(0)
    beyond = left_the_photograph(loaded.view, whole)
    assert beyond.any()
    assert not any((region & beyond).any() for region in loaded.regions.values())


def test_ordinary_views_are_as_they_were():
    """A person well inside a pincushion lens: nothing of a view is unknown, and no region is smaller."""
    whole, _ = behind_a_table(PINCUSHION)
    scene = open_scene(whole, fake_protocol("zju_occ", 6, 96, "none"))
    assert not any((view.mask == MaskState.UNKNOWN).any() for view in scene.train)
    assert all(view.hidden is None for view in scene.test)


def test_what_was_filmed_is_shown_where_the_occluder_stands_in_the_scene():
    """The photograph with the table and the room; a method that models the occluder may see it."""
    _, capture = behind_a_table()
    for view in open_scene(capture, natural(size=96)).train:
        assert view.filmed is not None
        assert np.array_equal(view.filmed, capture.image(0, view.frame))
        person = view.mask == MaskState.PERSON
        assert np.array_equal(view.filmed[person], view.image[person])
    small = open_scene(capture, natural(size=48)).train[0].filmed
    assert small is not None
    blocks = capture.image(0, 0).reshape(48, 2, 48, 2, 3).mean((1, 3))
    assert np.abs(small - blocks).max() <= 1


def test_nothing_is_filmed_behind_a_drawn_occluder():
    """Its photograph is the un-occluded truth."""
    whole, _ = behind_a_table()
    for rule in ("none", "strip-generic", "lower-half"):
        assert all(view.filmed is None for view in open_scene(whole, fake_protocol("zju_occ", 6, 96, rule)).train)


# ------------------------------------------------------------------------------------------------- scoring


def holes(view):
    """[H, W] masks of what an avatar may lack: its hips, what is hidden, a half, a blotch, all of it."""
    rows, columns = np.mgrid[: view.camera.height, : view.camera.width]
    body = rasterized(view.camera, view.body_pose).mask
    middle = rows[body].mean(), columns[body].mean()
    yield (rows > middle[0] - 8) & (rows < middle[0] + 4)
    yield np.zeros_like(body) if view.hidden is None else view.hidden
    yield columns < middle[1]
    yield np.hypot(rows - middle[0] + 10, columns - middle[1]) < 5
    yield np.ones_like(body)


@pytest.mark.parametrize("masks", ["of the person", "of what is visible"])
@pytest.mark.parametrize("rule", registry.names("occlusion"))
def test_a_complete_avatar_never_scores_below_the_same_avatar_with_a_hole(rule, masks):
    """In any region, by any metric, of any preset, under every occlusion rule."""
    whole, behind = behind_a_table()
    capture = whole if masks == "of the person" else behind
    strip = (47, 9) if rule == "fixed-strip" else None
    protocol = fake_protocol("zju_occ", 6, 96, "none" if strip else rule, strip)
    if masks == "of what is visible" and rule != "natural":
        with pytest.raises(BadInput, match=r"use --occlusion\.rule natural"):
            open_scene(replace(capture, visible_masks=True), protocol)
        return
    complete = open_scene(whole, fake_protocol("zju_occ", 6, 96, "none")).test
    scorer = Scorer.build(open_scene(capture, protocol), PRESETS)
    rng, compared = np.random.default_rng(0), 0
    for k in (0, 1):
        loaded = scorer.load(k)
        avatar = np.clip(complete[k].image + rng.normal(0, 0.004, complete[k].image.shape), 0, 1).astype(np.float32)
        avatar[complete[k].image.min(-1) == 1] = 1
        best = scorer.score(loaded, avatar, slow=False).scores
        for hole in holes(loaded.view):
            holed = np.where(hole[..., None], np.float32(1), avatar)
            for identity, score in scorer.score(loaded, holed, slow=False).scores.items():
                sign = 1 if METRICS[score.identity.partition("/")[0]].higher_is_better else -1
                assert np.isnan(score.value) == np.isnan(best[identity].value)
                assert not sign * score.value > sign * best[identity].value, (identity, score.value)
                compared += not np.isnan(score.value)
    assert compared > 100


def test_what_is_hidden_of_a_test_view_is_in_no_region_and_moves_no_number():
    _, capture = behind_a_table(DISTORTION)
    protocol = natural("zju_occ", 96)
    scorer = Scorer.build(open_scene(capture, protocol), PRESETS)
    loaded = scorer.load(0)
    hidden = loaded.view.hidden
    assert hidden is not None
    body = rasterized(loaded.view.camera, loaded.view.body_pose).mask
    assert (hidden & body).sum() > 0.05 * body.sum()
    assert not any((np.asarray(region) & hidden).any() for region in loaded.regions.values())
    assert not (body & ~hidden & ~loaded.view.silhouette).any()  # else it would be background that is person
    drawn = np.full_like(loaded.view.image, 0.3)
    other = np.where(hidden[..., None], np.nan, drawn)
    for image in (drawn, np.rint(255 * drawn).astype(np.uint8)):
        assert (
            scorer.score(loaded, image, slow=False).scores.keys() >= scorer.score(loaded, other, False).scores.keys()
        )
    first, second = (scorer.score(loaded, image, slow=False).scores for image in (drawn, other))
    for identity, score in first.items():
        assert score.value == second[identity].value or np.isnan(score.value)
        if identity.split("/")[3].startswith(("full", "box")):
            assert "the occluder stands in the test images" in score.reason


# ------------------------------------------------------------------------- protocol, plan, flags, commands


def test_the_occluder_covers_every_frame_and_the_protocol_says_so(curtain):
    protocol = load_protocol("custom_occ")
    assert protocol.content["occlusion"]["covers"]["fraction"] == 0.8
    for rule in ("natural", curtain):
        standing = protocol.with_fields({RULE: rule})
        assert standing.content["occlusion"] | {"in_scene": True} == standing.content["occlusion"]
        assert standing.occlusion.covers.fraction == 1
        assert standing.name == f"custom_occ@1+occlusion={rule}"
        assert protocol.with_fields({RULE: rule, COVERS: 1.0}).name == standing.name
        assert standing.with_fields({COVERS: 1.0}) is standing
        back = standing.with_fields({RULE: "strip-generic", FRACTION: 0.5, COVERS: 0.8})
        assert back.digest == protocol.digest
        for change in ({COVERS: 0.8}, {COVERS: 0.0}, {FRACTION: 0.5}):
            with pytest.raises(BadInput, match="leave it out"):
                protocol.with_fields({RULE: rule} | change)
            with pytest.raises(BadInput, match="leave it out"):
                standing.with_fields(change)
    released = load_protocol("ocmotion_visible")
    assert released.occlusion.in_scene
    assert released.name == "ocmotion_visible@2"
    assert protocol_from(released.content, "quick", "2") == released


@pytest.mark.parametrize("rule", ["none", "fixed-strip"])
def test_a_rule_that_knows_no_fraction_is_not_swept(rule):
    with pytest.raises(BadInput, match="whatever the fraction"):
        load_protocol("zju_occ").with_fields({RULE: rule, FRACTION: 0.3})
    assert load_protocol("zju_occ").with_fields({FRACTION: 0.3}).occlusion.rule == "strip-generic"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('rule = "strip-generic"\n', 'rule = "natural"\n', r"covers\.fraction is 0\.8"),
        ('unlisted = "strip-generic"', 'unlisted = "natural"', None),  # is not asked
        (
            'rule = "strip-generic"\nunlisted = "strip-generic"',
            'rule = "fixed-strip"\nunlisted = "natural"',
            "one kind",
        ),
        ("fraction = 0.5\n", "fraction = 0.5\nin_scene = true\n", "draws its occluder"),
    ],
)
def test_a_protocol_file_that_contradicts_its_rule_is_refused(tmp_path, old, new, message):
    text = (registry.package_folder("protocol", "custom_occ") / "custom_occ.toml").read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "mine.toml"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    if message is None:
        assert not read_protocol(path).occlusion.in_scene
        return
    with pytest.raises(BadInput, match=message):
        read_protocol(path)


def test_a_headline_without_a_number_is_refused(tmp_path):
    text = (registry.package_folder("protocol", "custom_occ") / "custom_occ.toml").read_text(encoding="utf-8")
    path = tmp_path / "mine.toml"
    path.write_text(text.replace('headline = "body"', 'headline = "full"'), encoding="utf-8")
    assert read_protocol(path).metrics.headline == "full"
    with pytest.raises(BadInput, match="headline is 'full'"):
        read_protocol(path).with_fields({RULE: "natural"})


def test_a_third_party_rule_is_treated_alike(curtain):
    """Also one that was put into a protocol past its check."""
    _, capture = behind_a_table()
    protocol = fake_protocol("zju_occ", 6, 48, curtain)
    scene = open_scene(capture, protocol)
    assert all(scene.hiding.covered)
    assert not any((view.mask == MaskState.BACKGROUND).any() for view in scene.train)
    assert Scorer.build(scene).withheld.keys() == {"full", "box"}
    with pytest.raises(BadInput, match="nobody knows what is behind it"):
        uncovered(scene)


def test_show_and_plan_say_what_has_no_number(bench, behind_a_table_folder):
    words = ("--occlusion.rule", "natural")
    shown = json.loads(bench("protocol", "show", "custom_occ", *words, "--json").out)
    assert shown["occlusion"]["covers"]["fraction"] == 1.0
    assert shown["occlusion"]["in_scene"] is True
    assert shown["absent"].keys() == {"full", "box"}
    text = bench("protocol", "show", "custom_occ", *words).out
    assert "absent.box" in text
    assert shown["digest"] in text
    assert "absent" not in bench("protocol", "show", "custom_occ").out
    plan = bench("plan", "--protocol", "custom_occ", "--data", behind_a_table_folder, *words)
    assert "left out: full -> None: the occluder stands in the test images" in plan.out
    assert "5 training views (5 occluded)" in plan.out
    assert "hides 0%" not in plan.out
    refused = bench(
        "plan", "--protocol", "custom_occ", "--data", behind_a_table_folder, *words, "--occlusion.covers", "0.8"
    )
    assert (refused.status, refused.err.count("\n")) == (2, 1)


@pytest.fixture(scope="module")
def behind_a_table_folder(tmp_path_factory):
    """The same as a plain scene folder on disk."""
    folder = tmp_path_factory.mktemp("table") / "table"
    whole = turning_capture(10)
    plain_scene.write_cameras(folder, {"phone": whole.cameras[0]})
    plain_scene.write_poses(folder, whole.poses)
    write_body(folder / "body.npz", the_body())
    for k in range(10):
        image, mask = whole.image(0, k), whole.silhouette(0, k)
        image[TABLE], mask[TABLE] = (150, 75, 0), False
        plain_scene.write_frame(folder, k, image, mask)
    return folder


def test_a_run_behind_a_table(bench, mannequin, behind_a_table_folder, tmp_path):
    words = ["--protocol", "custom_occ", "--data", behind_a_table_folder, "--occlusion.rule", "natural"]
    outcome = bench("run", *words, "--runs", tmp_path, "--method", "mannequin", "--image-size", "64")
    assert outcome.status == 0, outcome.err
    (folder,) = (p.parent for p in tmp_path.glob("*/run.json"))
    rows = [json.loads(line) for name in ("scores", "calibration") for line in (folder / f"{name}.jsonl").open()]
    curve = [json.loads(line) for line in (folder / "curve.jsonl").open()]
    for scores in [row["scores"] for row in rows] + [point["scores"] for point in curve]:
        values = {region: float(scores[f"psnr/pooled/range1/{region}/v1"]) for region in ("body", "full", "box")}
        assert not np.isnan(values["body"])
        assert np.isnan([values["full"], values["box"]]).all()
    about = json.loads((folder / "run.json").read_text())["about"]
    assert {"full", "box"} <= {o["field"] for o in about["left_out"]}
    assert about["hidden_share"] > 0.05
    report = bench("report", folder, "--preset", "gauhuman", "--data", behind_a_table_folder)
    assert report.status == 0, report.err
    assert "the occluder stands in the test images" in report.out
    prepared = bench("prepare", *words, "--image-size", "64", "--out", tmp_path / "handed")
    assert prepared.status == 0, prepared.err
    sheet = np.asarray(Image.open(folder / "contact_sheet.png"))
    assert (sheet == 70).all(-1).mean() > 0.2
