"""The site in a real browser: it opens from a file, asks nobody for anything, shows what was scored, and draws the
avatar as the bench's own renderer does."""

import base64
import io
import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from PIL import Image

from ihbench.body import load_body
from ihbench.body.pose import BodyPose
from ihbench.metrics.eight_bit import displayed
from ihbench.metrics.psnr import psnr
from ihbench.record.finished_run import FinishedRun
from ihbench.record.results import read_result
from ihbench.reports.site import baking, build
from ihbench.reports.site.corrections import Corrections
from ihbench.show import movie
from ihbench.show.subject import Subject
from tests.reports.chromium import BROWSER, Chromium
from tests.reports.made_up_runs import made_up
from tests.reports.site_reading import Page, Plates, value

pytestmark = pytest.mark.skipif(BROWSER is None, reason="no Chromium here: chromium, chromium-browser, google-chrome")

HOSTILE = "<img src=x onerror=\"document.title='taken'\">"
OUR_SCHEMES = ("file:", "data:", "blob:", "about:")
BODY, SILHOUETTE, MOVED = 30.0, 0.98, 28.0  # dB, IoU, dB: what a page's avatar must reach


@pytest.fixture(scope="module")
def site(studio, finished, tmp_path_factory):
    other = tmp_path_factory.mktemp("runs") / finished.folder.name
    shutil.copytree(finished.folder, other)
    record = json.loads((other / "run.json").read_text())
    record["about"]["label"] = HOSTILE
    (other / "run.json").write_text(json.dumps(record))
    with studio.in_its_world():
        return build.build([read_result(finished.folder), read_result(other)], views=2)


@pytest.fixture(scope="module")
def file(site, tmp_path_factory):
    """A single file, whose pictures a script may read again."""
    path = tmp_path_factory.mktemp("site") / "index.html"
    build.write_single(site, path)
    return path


@pytest.fixture(scope="module")
def browser():
    with Chromium() as running:
        yield running


@pytest.fixture
def opened(browser, file):
    """Open a screen; what the browser complains of, or asks others for, fails the test."""
    browser.console.clear()
    browser.requests.clear()

    def open_screen(words: str = "", of=None) -> Chromium:
        browser.send("Page.navigate", url="about:blank")
        browser.open(f"{(of or file).as_uri()}#{words}")
        return browser

    yield open_screen
    assert browser.console == []
    assert [url for url in browser.requests if not url.startswith(OUR_SCHEMES)] == []


def drawn(browser):
    """[H, W, 4] in 0..1, premultiplied, of the avatar's canvas."""
    browser.wait("document.querySelector('canvas')?.dataset.drawn > 0")
    height, width = browser.value("(c => [c.height, c.width])(document.querySelector('canvas'))")
    text = browser.value(
        "(p => { let s = '';"
        " for (let i = 0; i < p.length; i += 8192) s += String.fromCharCode(...p.subarray(i, i + 8192));"
        " return btoa(s); })(document.querySelector('canvas').readback())"
    )
    return np.frombuffer(base64.b64decode(text), np.uint8).reshape(height, width, 4) / 255


def test_a_number_leads_to_the_view_that_has_it(opened, site):
    browser = opened()
    run = site.data["runs"][0]
    name = next(i for i in run["identities"] if i.startswith("psnr") and "/hidden/" in i)
    browser.value(f"document.querySelector('button.number[data-identity=\"{name}\"]').click()")
    texts = browser.value("[...document.querySelectorAll('.drill .views a b')].map(b => b.textContent)")
    k = run["identities"].index(name)
    scores = [value(v["scores"][k], run["reasons"]) for v in run["views"]]
    known = sorted(score for score in scores if not isinstance(score, str))
    assert texts[: len(known)] == [f"{score:.2f}" for score in known]
    assert len(texts) == len(scores)
    browser.value("document.querySelector('.drill .views a').click()")
    browser.wait(f"document.querySelector('table.scores td[data-identity=\"{name}\"]')")
    shown = browser.value(f"document.querySelector('table.scores td[data-identity=\"{name}\"]').dataset.value")
    assert float(shown) == known[0]
    cells = browser.value(
        "[...document.querySelectorAll('table.scores td')].map(td => [td.dataset.identity, td.dataset.value])"
    )
    address = browser.value("location.hash")
    view = next(v for v in run["views"] if f"camera={v['camera']}&frame={v['frame']}&" in f"{address}&")
    assert len(cells) == len(run["identities"])
    for identity, text in cells:
        stored = view["scores"][run["identities"].index(identity)]
        assert text == str(stored[0]) if isinstance(stored, list) else float(text) == float(stored)
    for tab in ("scenes", "frame", "curves", "about"):  # every screen is made without a complaint
        opened(tab)
        assert browser.value("document.getElementById('main').children.length") > 0


def test_sorting_puts_the_best_first(opened):
    browser = opened()
    browser.value(
        "[...document.querySelectorAll('.sorter')].find(b => b.textContent.startsWith('FLIP body')).click()"
    )
    order = browser.value("document.querySelector('th[aria-sort=ascending]')?.textContent")
    assert order == "FLIP body ↓"
    first, *_, last = browser.value("[...document.querySelectorAll('table.board tbody tr')].map(r => r.className)")
    assert (first, last) == ("method", "bound")  # what bounds the others is not ranked among them


def test_regions_and_errors_are_those_of_the_bench(opened, site):
    """The overlay's pixels are the mask's, and the error that the browser blends is the contact sheet's."""
    from ihbench.scoring.contact_sheet import error_image

    view = site.data["frames"][0]["views"][0]
    browser = opened(f"frame?camera={view['camera']}&frame={view['frame']}&left=truth&right=e0")
    browser.value("document.querySelector('.chip.hidden').click()")
    pixels = browser.value(
        "(async () => { const i = document.querySelector('.stage [data-region=hidden]'); await i.decode();"
        " const c = new OffscreenCanvas(i.naturalWidth, i.naturalHeight).getContext('2d'); c.drawImage(i, 0, 0);"
        " const all = c.getImageData(0, 0, i.naturalWidth, i.naturalHeight).data;"
        " return [...all].filter((_, k) => k % 4 === 3).map(a => +(a > 0)); })()"
    )
    mask = np.asarray(Image.open(io.BytesIO(site.files[view["masks"]["hidden"]])).convert("RGBA"))[..., 3] > 0
    assert mask.any()
    assert np.array_equal(np.array(pixels).reshape(mask.shape), mask)
    # the blended error, pixel for pixel, at the picture's own size
    width, height = view["size"]
    browser.value(
        "document.querySelector('.chip.hidden').click(); const p = document.querySelectorAll('.panes figure')[3];"
        "const e = p.querySelector('.error'); document.body.replaceChildren(e, document.getElementById('filters'));"
        f"e.style.cssText = 'position:fixed;left:0;top:0;width:{width}px;height:{height}px';"
        "for (const i of e.children) i.style.cssText = 'position:absolute;left:0;top:0;width:100%;height:100%'"
    )
    clip = {"x": 0, "y": 0, "width": width, "height": height, "scale": 1}
    shot = browser.send("Page.captureScreenshot", format="png", clip=clip)["data"]
    seen = np.asarray(Image.open(io.BytesIO(base64.b64decode(shot))).convert("RGB")).astype(int)
    truth, made = (
        np.asarray(Image.open(io.BytesIO(site.files[name])).convert("RGB"))
        for name in (view["truth"], view["predictions"]["0"])
    )
    assert np.abs(seen - error_image(made, truth)).max() <= 2  # two roundings


def test_a_name_that_means_harm_does_none(opened):
    browser = opened()
    assert HOSTILE in browser.value("document.body.innerText")
    assert browser.value("document.querySelectorAll('img').length") == 0
    refused = browser.value(
        "(() => { const s = document.createElement('script');"
        " try { s.textContent = 'document.title = 1'; } catch { return 'types'; }"
        " document.head.append(s); return document.title; })()"
    )
    assert refused == "types"  # the policy takes no text as a script at all
    inner = "(() => { try { document.body.innerHTML = '<b>x'; return 'taken'; } catch { return 'refused'; } })()"
    assert browser.value(inner) == "refused"
    style = "(b => { b.setAttribute('style', 'color: red'); return b.style.color; })(document.createElement('b'))"
    assert browser.value(style) == ""
    assert browser.value("fetch('https://example.org/').then(() => 'left', () => 'stayed')") == "stayed"
    assert any("Content Security Policy" in line or "TrustedScript" in line for line in browser.console)
    assert browser.value("document.title") == build.TITLE
    browser.console.clear()  # these complaints were asked for
    browser.requests[:] = [url for url in browser.requests if not url.startswith("https://example.org")]


def test_runs_that_failed_and_names_without_end(opened, tmp_path):
    """Every screen is made, says why, and stays as wide as the window."""
    failed = made_up(tmp_path, "W" * 90, "W" * 90, seed=1)
    outcome = replace(failed.record.outcome, status="failed", reason=f"no {'W' * 200} there")
    failed = replace(failed, record=replace(failed.record, outcome=outcome), rows={})
    for name, runs in {"failed": [failed], "both": [made_up(tmp_path, "W" * 90, "W" * 90), failed]}.items():
        page = tmp_path / f"{name}.html"
        build.write_single(build.build(runs, [f"{'W' * 200}: is damaged"]), page)
        for tab in ("leaderboard", "scenes", "frame", "curves", "avatar", "about"):
            browser = opened(tab, page)
            assert browser.value("document.documentElement.scrollWidth") <= 1300, (name, tab)
            if tab in ("leaderboard", "about"):
                assert outcome.reason in browser.value("document.getElementById('main').textContent")


def test_on_a_telephone_in_the_dark_by_keys(opened):
    browser = opened()
    browser.resize(390, 800)
    browser.dark()
    try:
        for tab in ("leaderboard", "scenes", "frame", "curves", "avatar", "about"):
            opened(tab)
            assert browser.value("document.documentElement.scrollWidth") <= 390, tab
            assert browser.value("document.querySelector('header .badge').textContent") == "stand-in data", tab
        background = browser.value("getComputedStyle(document.body).backgroundColor")
        assert background == "rgb(20, 23, 27)"
        opened("frame")
        reached = set()
        name = "(a => a.tagName + ':' + (a.id || a.textContent || a.ariaLabel))"
        for _ in range(80):
            browser.key("Tab")
            reached.add(browser.value(f"{name}(document.activeElement)"))
        controls = browser.value(f"[...document.querySelectorAll('a[href], button, select, input')].map({name})")
        assert len(controls) > 15
        assert set(controls) <= reached
        before = browser.value("document.querySelector('h3').textContent")
        browser.value("document.activeElement.blur()")
        browser.key("ArrowRight")
        assert browser.value("document.querySelector('h3').textContent") != before
    finally:
        browser.dark(False)
        browser.resize(1300, 900)


def test_the_avatar_is_drawn_as_the_bench_draws_it(opened, studio, site, finished):
    view = site.data["frames"][0]["views"][1]
    where = f"avatar?run=0&camera={view['camera']}&frame={view['frame']}"
    with studio.in_its_world():
        run = FinishedRun(finished.folder)
        subject, scene = Subject(run), run.scene
        truth = next(v for v in scene.test if (v.camera_id, v.frame) == (view["camera"], view["frame"]))
        clip = site.data["motions"]["shared"]["bow"]
        angles = np.frombuffer(base64.b64decode(clip["pose"]), "<i2").reshape(-1, 24, 3)[clip["frames"] // 2] / 1e4
        pose = truth.body_pose
        bowed = BodyPose(np.concatenate([pose.pose[:1], angles[1:]]), pose.betas, pose.transl)
        for words, posed, least in ((where, pose, BODY), (f"{where}&motion=bow&t=0.5", bowed, MOVED)):
            rgb, alpha = subject.avatar.render(truth.camera, posed)
            seen = drawn(opened(words))
            ours = displayed(seen[..., :3] + 1 - seen[..., 3:])
            here, there = seen[..., 3] > 0.5, alpha > 0.5
            assert there.sum() > 200
            assert psnr(ours, displayed(rgb), here | there) >= least
            assert (here & there).sum() / (here | there).sum() >= SILHOUETTE
        stood, _ = subject.avatar.render(truth.camera, pose)
        assert psnr(displayed(stood), displayed(rgb)) < MOVED  # a motion that does not move would be seen


@pytest.mark.parametrize("turning", [False, True])
def test_general_gaussians_are_drawn_as_the_bench_draws_them(opened, studio, site, finished, tmp_path, turning):
    """Flat and half transparent ones, from every side of other colours, which may turn with the body; elbows turn by
    themselves; in a test view and moved."""
    view = site.data["frames"][0]["views"][0]
    with studio.in_its_world():
        scene = FinishedRun(finished.folder).scene
        truth = next(v for v in scene.test if (v.camera_id, v.frame) == (view["camera"], view["frame"]))
        body, pose = load_body(), truth.body_pose
        avatar = Plates(body, pose.betas, degree=3, told=True, learned=True, turning=turning)
        subject = SimpleNamespace(avatar=avatar, body=body, betas=pose.betas)
        made = baking.bake(subject, [v.body_pose for v in scene.train[:6]], None)  # type: ignore[arg-type]
        assert not isinstance(made, str)
        assert made.corrections is not None
        assert made.avatar.turning == turning
        clip = site.data["motions"]["shared"]["bow"]
        angles = np.frombuffer(base64.b64decode(clip["pose"]), "<i2").reshape(-1, 24, 3)[clip["frames"] // 2] / 1e4
        bowed = BodyPose(np.concatenate([pose.pose[:1], angles[1:]]), pose.betas, pose.transl)
        moved = np.repeat(made.corrections(bowed)[None], clip["frames"] // 2 + 1, 0)
        at = made.corrections(pose)[None]
        kept = Corrections.of({f"view {view['camera']}/{view['frame']}": at, "motion bow": moved})
        own, skin = made.avatar.packed()
        carried = {"own.bin": own, "skin.bin": skin, "moves.bin": kept.packed()}
        about = {**site.data["avatars"]["0"], **made.avatar.about, "own": "own.bin", "skin": "skin.bin"}
        about["corrected"] = {**kept.about, "file": "moves.bin"}
        page = build.Site("plates", {**site.data, "avatars": {"0": about}}, site.files, carried)
        build.write_single(page, tmp_path / "plates.html")
        where = f"avatar?run=0&camera={view['camera']}&frame={view['frame']}"
        for words, posed in ((where, pose), (f"{where}&motion=bow&t=0.5", bowed)):
            rgb, alpha = (x.numpy() for x in avatar.posed_gaussians(posed).draw(truth.camera, (1.0, 1.0, 1.0)))
            seen = drawn(opened(words, tmp_path / "plates.html"))
            assert 0.2 < np.quantile(alpha[alpha > 0.02], 0.3) < 0.95  # they are half transparent
            ours = displayed(seen[..., :3] + 1 - seen[..., 3:])
            near = psnr(ours, displayed(np.clip(rgb, 0, 1)), alpha > 0.02)
            assert near > 36
            assert np.quantile(np.abs(seen[..., 3] - alpha)[alpha > 0.02], 0.99) < 0.06
        stood, _ = made.avatar.render(body, truth.camera, bowed, (1.0, 1.0, 1.0))
        assert psnr(displayed(stood), displayed(np.clip(rgb, 0, 1)), alpha > 0.02) < near - 5  # arms uncorrected


def test_drawn_large_an_avatar_has_no_gaps(opened, site, tmp_path):
    """It learned under the blur of its images' pixels, and is drawn with it."""

    def gaps(page):
        solid = (drawn(opened("avatar?run=0&motion=march&t=0.2", page))[..., 3] > 0.5).astype(np.uint8)
        filled = cv2.morphologyEx(solid, cv2.MORPH_CLOSE, np.ones((9, 9), np.uint8))
        return 1 - solid.sum() / filled.sum()

    without = {"0": {**site.data["avatars"]["0"], "pixel": None}}
    build.write_single(replace(site, data={**site.data, "avatars": without}), tmp_path / "without.html")
    assert gaps(None) < 0.02 < gaps(tmp_path / "without.html")


def test_painting_turning_and_a_lost_context(opened):
    browser = opened("avatar?run=0&motion=march&t=0.2")
    plain = drawn(browser)
    assert plain[..., 3].max() > 0.9
    assert plain[..., :3].var() > 0
    count = browser.value("document.querySelector('canvas').dataset.drawn")
    browser.value("document.querySelector('.chip.visible').click()")
    browser.wait("document.querySelector('canvas')?.dataset.drawn > 0")
    tinted = drawn(browser)
    assert np.array_equal(plain[..., 3] > 0, tinted[..., 3] > 0)
    assert np.abs(plain - tinted)[..., :3].max() > 0.2
    browser.value("document.querySelector('.chip.visible').click()")
    browser.wait("document.querySelector('canvas')?.dataset.drawn > 0")
    browser.key("ArrowRight")
    browser.wait("document.querySelector('canvas').dataset.drawn > 1")
    assert (np.abs(drawn(browser) - plain).max(-1) > 0.1).sum() > 100
    assert int(count) >= 1
    context = "document.querySelector('canvas').getContext('webgl2')"
    browser.value(f"{context}.getExtension('WEBGL_lose_context').loseContext()")
    browser.wait("document.querySelector('img.still')?.naturalWidth > 0")
    first = browser.value("document.querySelector('img.still').src")
    browser.key("ArrowRight")
    assert browser.value("document.querySelector('img.still').src") != first
    browser.console[:] = [line for line in browser.console if "WebGL" not in line and "CONTEXT_LOST" not in line]


def test_a_folder_opens_too(opened, site, tmp_path):
    index = build.write_folder(site, tmp_path)
    browser = opened("frame", index)
    browser.wait("[...document.images].every(i => i.complete && i.naturalWidth > 0)")
    assert browser.value("document.images.length") > 4
    assert any("/files/" in url for url in browser.requests)
    assert Page(index.read_text()).policy["img-src"] == "'self' data: blob:"
    with pytest.raises(AssertionError):  # and the check can fail
        assert browser.value("document.querySelector('canvas') !== null")


def test_an_animation_of_ours_plays(browser, tmp_path):
    colours = ((255, 0, 0), (0, 0, 255))
    frames = [np.full((32, 48, 3), colour, np.uint8) for colour in colours]
    (tmp_path / "turn.webp").write_bytes(movie.encoded(iter(frames), ".webp", 5))
    (tmp_path / "page.html").write_text('<!DOCTYPE html><link rel="icon" href="data:,"><img src="turn.webp">')
    browser.open((tmp_path / "page.html").as_uri(), "document.images[0]?.naturalWidth === 48")
    seen = set()
    for _ in range(200):
        shot = browser.send("Page.captureScreenshot", format="png")["data"]
        pixels = np.asarray(Image.open(io.BytesIO(base64.b64decode(shot))).convert("RGB"))
        seen.add(tuple((pixels[20, 20] > 128).tolist()))
        if len(seen) == 2:
            break
    assert seen == {(True, False, False), (False, False, True)}
