"""Training and test views: nothing behind the occluder gets out, and every pixel stays where the camera says."""

import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np
import pytest

from ihbench.body.pose import BodyPose
from ihbench.camera import Camera, distort
from ihbench.config_fields import replaced
from ihbench.errors import BadInput
from ihbench.scene.contracts import MaskState
from ihbench.scene.protocol import Span, load_protocol
from ihbench.scene.views import LazyViews, TestViewKey, Undistorter, open_scene
from tests.bench.fake_capture import (
    DISTORTION,
    SIZE,
    FakeCapture,
    a_camera,
    fake_protocol,
    rasterized,
    turning_capture,
)

STRIP = (47, 9)  # mid, width: columns 43 ... 50 of the original image
COLUMNS = slice(43, 51)


@pytest.fixture(scope="module", params=[None, DISTORTION], ids=["pinhole", "distorted"])
def capture(request):
    return turning_capture(distortion=request.param)


def noise(camera, frame, shape):
    return np.random.default_rng((camera, frame)).integers(0, 256, shape)


def scrambled(capture):
    """The same capture with other pixels and another silhouette behind the strip."""

    def image(camera, frame, pixels):
        pixels[:, COLUMNS] = noise(camera, frame, pixels[:, COLUMNS].shape)
        return pixels

    def silhouette(camera, frame, pixels):
        pixels[:, COLUMNS] = noise(camera, frame, pixels[:, COLUMNS].shape) > 127
        return pixels

    return replace(capture, edit_image=image, edit_silhouette=silhouette)


def same(a, b):
    return np.array_equal(a.image, b.image) and np.array_equal(a.mask, b.mask)


# ------------------------------------------------------------------------------------ what may not get out


@pytest.mark.parametrize("size", [SIZE // 2, SIZE // 4, 40])
@pytest.mark.parametrize("base", ["zju_occ", "zju_occ_occnerf"])
def test_nothing_behind_the_strip_reaches_a_training_view(capture, base, size):
    protocol = fake_protocol(base, size=size, strip=STRIP)
    clean, dirty = open_scene(capture, protocol), open_scene(scrambled(capture), protocol)
    assert sum(clean.hiding.covered) == 8
    for covered, a, b in zip(clean.hiding.covered, clean.train, dirty.train, strict=True):
        assert same(a, b) == covered


def test_a_strip_nobody_hides_behind_hides_the_frame_anyway(capture):
    scene = open_scene(capture, fake_protocol(strip=STRIP))
    for covered, view in zip(scene.hiding.covered, scene.train, strict=True):
        assert (view.mask == MaskState.UNKNOWN).any() == covered
        assert set(np.unique(view.mask)) == ({0, 1, 2} if covered else {0, 1})


# --------------------------------------------------------------------------------------- where UNKNOWN is


def blank_capture(name, distortion=None):
    """Someone who fills the whole of a 1024-px image."""
    width = 1024
    K = np.array([[1040.0, 0, 515], [0, 1042, 509], [0, 0, 1]])
    camera = Camera(K, np.eye(3), np.array([0, 0, 3.0]), width, width, distortion)
    photograph = np.full((width, width, 3), 90, np.uint8), np.ones((width, width), bool)
    pose = BodyPose(np.zeros((24, 3)), np.zeros(10), np.zeros(3))
    return FakeCapture([pose] * 2, [camera] * 2, name=name, _photographs={(0, 0): photograph, (0, 1): photograph})


def published(base):
    protocol = fake_protocol(base, n_frames=2, size=512)
    strips = load_protocol(base, "paper").occlusion.strips
    rule = {"rule": "fixed-strip", "strips": strips, "reference_width": 1024, "covers.fraction": 1.0}
    return replaced(protocol, {f"occlusion.{name}": value for name, value in rule.items()})


@pytest.mark.parametrize(
    ("base", "subject", "first", "last"),
    [
        ("zju_occ", "377", 213, 247),
        ("zju_occ", "386", 188, 227),
        ("zju_occ", "387", 212, 236),
        ("zju_occ_occnerf", "387", 209, 241),
        ("zju_occ", "392", 189, 227),
        ("zju_occ", "393", 200, 233),
        ("zju_occ", "394", 193, 224),
        ("zju_occ_occnerf", "394", 196, 227),
    ],
)
def test_unknown_is_the_published_strip_at_half_size(base, subject, first, last):
    """`first` ... `last` are what nearest ×0.5 hides (protocols.md sec. 9). A strip that starts at an odd column
    covers half of the pixel before, which is not to be trusted either."""
    view = open_scene(blank_capture(subject), published(base)).train[0]
    mid, width = published(base).occlusion.strips[subject]
    start = (mid - width // 2) // 2
    unknown = np.flatnonzero((view.mask == MaskState.UNKNOWN).all(0))
    assert unknown.tolist() == list(range(start, last + 1))
    assert first - start in (0, 1)
    assert (view.mask[:, :start] == MaskState.PERSON).all()
    assert (view.mask[:, last + 1 :] == MaskState.PERSON).all()


def test_unknown_follows_the_lens():
    """A straight strip of the original is curved after undistortion: ask the lens where each pixel came from."""
    scene = open_scene(blank_capture("377", DISTORTION), published("zju_occ"))
    camera, view = scene.capture.camera(0), scene.train[0]
    rows, cols = np.mgrid[:512, :512] + 0.5
    K = scene.train[0].camera.K
    x, _ = distort((cols - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1], DISTORTION)
    column = camera.K[0, 0] * x + camera.K[0, 2]
    unknown = view.mask == MaskState.UNKNOWN
    assert unknown[(column > 425) & (column < 495)].all()
    assert not unknown[(column < 425 - 2.5) | (column > 495 + 2.5)].any()
    assert not (unknown.any(0) == unknown.all(0)).all(), "the strip should be curved"


# ------------------------------------------------------------------------------------------------- colours


def undistorted(capture, image):
    """An image of camera 0 as OpenCV straightens it."""
    camera = capture.camera(0)
    return image if camera.distortion is None else cv2.undistort(image, camera.K_opencv, camera.distortion)


@pytest.mark.parametrize("background", [(1.0, 1.0, 1.0), (0.0, 0.0, 0.0), (0.2, 0.4, 0.6)])
def test_background_is_painted_exactly(capture, background):
    protocol = fake_protocol(strip=STRIP)
    protocol = replaced(protocol, {"image.background": background})
    scene = open_scene(capture, protocol)
    for view in scene.train:
        person = undistorted(capture, 255 * capture.silhouette(0, view.frame).astype(np.uint8)) > 0
        nobody = ~person.reshape(48, 2, 48, 2).any((1, 3)) | (view.mask == MaskState.UNKNOWN)
        assert nobody.mean() > 0.5
        assert (view.image[nobody] == np.round(255 * np.array(background))).all()


@pytest.mark.parametrize("background", [(0.5, 0.9, 0.3), (0.501, 0.499, 0.123)])
@pytest.mark.parametrize("base", ["zju_occ", "zju_occ_occnerf"])
def test_hidden_pixels_have_the_very_colour_of_the_background(base, background):
    """Whatever the rounding: a step between the two would draw the occluder's outline."""
    protocol = fake_protocol(base, strip=STRIP)
    protocol = replaced(protocol, {"image.background": background})
    view = open_scene(turning_capture(), protocol).train[0]
    assert (view.image[view.mask == MaskState.UNKNOWN] == view.image[0, 0]).all()


def test_the_studio_is_gone_and_the_person_is_there(capture):
    scene = open_scene(capture, fake_protocol(rule="none"))
    assert not any(scene.train[0].mask.ravel() == MaskState.UNKNOWN)
    for view in (scene.train[0], scene.train[7]):
        person = undistorted(capture, 255 * capture.silhouette(0, view.frame).astype(np.uint8)) == 255
        solid = person.reshape(48, 2, 48, 2).all((1, 3))
        expected = undistorted(capture, capture.image(0, view.frame)).reshape(48, 2, 48, 2, 3).mean((1, 3))
        assert solid.sum() > 100
        assert (view.mask[solid] == MaskState.PERSON).all()
        assert np.abs(view.image[solid] - expected[solid]).max() < 1


@pytest.mark.parametrize(("to_8bit", "expected"), [("truncate", 100), ("round", 101)])
def test_eight_bits(to_8bit, expected):
    rule = replace(fake_protocol().image, size=SIZE // 2, to_8bit=to_8bit)
    image = np.full((SIZE, SIZE, 3), 101, np.uint8)
    image[::2, ::2] = 100  # a quarter of every block: the mean is 100.75
    got = Undistorter(a_camera(), rule).person(image, np.ones((SIZE, SIZE), bool))[0]
    assert (got == expected).all()
    whole = np.full((SIZE, SIZE, 3), 77, np.uint8)
    assert (Undistorter(a_camera(), rule).person(whole, np.ones((SIZE, SIZE), bool))[0] == 77).all()


@pytest.mark.parametrize(("edge", "levels"), [("hard", {0, 255}), ("soft", set(range(256)))])
def test_edges(edge, levels):
    """White on black through a lens: a hard edge has no grey, a soft one does."""
    rule = replace(fake_protocol().image, size=SIZE, edge=edge, background=(0.0, 0.0, 0.0))
    person = rasterized(a_camera(), turning_capture().poses[0]).mask
    image = np.full((SIZE, SIZE, 3), 255, np.uint8)
    got = set(np.unique(Undistorter(a_camera(distortion=DISTORTION), rule).person(image, person)[0]).tolist())
    assert got <= levels
    assert (len(got) > 2) == (edge == "soft")


# -------------------------------------------------------------------------------------------- where pixels go


def test_undistortion_is_opencvs():
    camera = a_camera(size=200, distortion=DISTORTION)
    image = np.random.default_rng(0).integers(0, 256, (200, 200, 3)).astype(np.uint8)
    straight = Undistorter(camera, fake_protocol().image).straighten(image)
    assert np.array_equal(straight, cv2.undistort(image, camera.K_opencv, DISTORTION))
    assert np.abs(straight.astype(int) - image).mean() > 5


@pytest.mark.parametrize("size", [SIZE, SIZE // 2, SIZE // 3, 70])
@pytest.mark.parametrize("distortion", [None, DISTORTION], ids=["pinhole", "distorted"])
def test_a_point_projects_to_the_same_feature_after_undistortion_and_resampling(size, distortion):
    """The half-pixel test: the centroid of a small blob at the point's image, to 0.1 px."""
    camera = a_camera(distortion=distortion)
    lens = Undistorter(camera, replace(fake_protocol().image, size=size))
    rng = np.random.default_rng(4)
    points = rng.uniform(-0.75, 0.75, (12, 3)) * [1, 1, 0.3]
    rows, cols = np.mgrid[:SIZE, :SIZE] + 0.5
    for point in points:
        x, y, _ = camera.project(point)
        blob = np.exp(-((cols - x) ** 2 + (rows - y) ** 2) / (2 * 2.0**2)).astype(np.float32)
        small = lens.shrink(lens.straighten(blob), "area")
        i, j = np.mgrid[:size, :size] + 0.5
        centroid = np.array([(small * j).sum(), (small * i).sum()]) / small.sum()
        np.testing.assert_allclose(centroid, lens.camera.project(point)[:2], atol=0.1)


@pytest.mark.parametrize("distortion", [None, DISTORTION], ids=["pinhole", "distorted"])
@pytest.mark.parametrize("base", ["zju_occ", "zju_occ_occnerf"])
def test_masks_show_the_projected_body(distortion, base):
    poses = turning_capture().poses[3:5]
    capture = FakeCapture(poses, [a_camera(azimuth, 384, distortion=distortion) for azimuth in (0.0, 1.5)])
    scene = open_scene(capture, fake_protocol(base, n_frames=2, rule="none", size=384))
    masks = [view.mask == MaskState.PERSON for view in scene.train] + [view.silhouette for view in scene.test]
    for view, mask in zip([*scene.train, *scene.test], masks, strict=True):
        expected = rasterized(view.camera, view.body_pose).mask
        assert np.abs(np.argwhere(mask).mean(0) - np.argwhere(expected).mean(0)).max() < 0.2
        assert (mask & expected).sum() / (mask | expected).sum() > 0.98
        assert view.camera.distortion is None
        assert (view.camera.width, view.camera.height) == mask.shape == (384, 384)


# ------------------------------------------------------------------------------------------------- the truth


def test_truth_is_never_occluded_and_never_of_the_training_camera(capture):
    scene = open_scene(capture, fake_protocol(strip=STRIP))
    bare = open_scene(capture, fake_protocol(rule="none"))
    assert [key.name for key in scene.test_keys[:5]] == [
        "cam1/000000", "cam1/000003", "cam1/000006", "cam1/000009", "cam2/000000",
    ]  # fmt: skip
    assert len(scene.test) == len(scene.test_keys) == 12
    for key, view, other in zip(scene.test_keys, scene.test, bare.test, strict=True):
        assert (view.frame, view.camera_id) == (key.frame, key.camera_id)
        assert key.camera != scene.protocol.train.camera
        assert view.camera.R.tolist() == capture.camera(key.camera).R.tolist()
        assert np.array_equal(view.image, other.image)
        assert np.array_equal(view.silhouette, other.silhouette)
        assert view.image.dtype == np.float32
        assert np.array_equal(np.round(view.image * 255).astype(np.uint8).astype(np.float32) / 255, view.image)
        assert view.image[view.silhouette].std() > 0.1


def test_views_carry_what_they_were_taken_with(capture):
    scene = open_scene(
        capture, replaced(fake_protocol(strip=STRIP), {"train.frames": Span(1, 10, 3), "train.camera": 2})
    )
    assert [view.frame for view in scene.train] == [1, 4, 7]
    assert scene.hiding.covered == (True, True, True)
    assert {view.camera_id for view in scene.train} == {"cam2"}
    assert scene.train[1].body_pose is capture.poses[4]
    assert {key.camera for key in scene.test_keys} == {0, 1, 3}


# ---------------------------------------------------------------------------------------- captures too small


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"train.frames": Span(0, 11, 1)}, "needs frame 10"),
        ({"test.frames": Span(0, 40, 15)}, "needs frame 30"),
        ({"train.camera": 4}, "camera index 4"),
        ({"test.cameras.stop": 1}, "no test view"),
        ({"test.cameras.start": 5, "test.cameras.stop": 9}, "no test view"),
    ],
)
def test_a_capture_that_lacks_frames_or_cameras_is_refused(change, words):
    with pytest.raises(BadInput, match=words) as caught:
        open_scene(turning_capture(), replaced(fake_protocol(), change))
    assert "\n" not in str(caught.value)
    assert "drawn" in str(caught.value)


def test_a_protocol_without_a_training_frame_is_refused():
    with pytest.raises(BadInput, match="drawn"):
        open_scene(
            turning_capture(), replaced(fake_protocol(rule="none"), {"train.frames": Span(10, "max_frames", 1)})
        )


# ----------------------------------------------------------------------------------------------- LazyViews


def test_lazy_views_make_each_item_once_and_index_like_a_list():
    made = []
    views = LazyViews(lambda k: made.append(k) or f"view {k}", 5)
    plain = [f"view {k}" for k in range(5)]
    assert made == []
    assert views[-1] == plain[-1]
    assert views[np.int64(2)] == plain[2]
    assert made == [4, 2]
    assert [*views] == plain
    assert views[1:4] == plain[1:4]
    assert views[::-2] == plain[::-2]
    assert views[7:] == []
    assert len(views) == 5
    assert sorted(made) == [0, 1, 2, 3, 4]
    for index in (5, -6):
        with pytest.raises(IndexError):
            views[index]


def test_lazy_views_hold_no_more_than_they_may_and_drop_the_oldest():
    made = []
    views = LazyViews(lambda k: made.append(k) or k, 10, held=3)
    for k in (0, 1, 2, 0, 3):  # 1 is the longest unused when 3 comes
        views[k]
    assert made == [0, 1, 2, 3]
    views[0], views[2], views[3]
    assert made == [0, 1, 2, 3]
    views[1]
    assert made == [0, 1, 2, 3, 1]
    views.preload().wait()
    assert len(views._kept) == 3


def test_lazy_views_from_many_threads():
    """All threads wait for each other inside `make`, so they are truly in there at once."""
    together = threading.Barrier(4, timeout=20)
    first = threading.local()

    def make(k):
        if not getattr(first, "met", False):
            first.met = True
            together.wait()
        return k * k

    views = LazyViews(make, 40, held=7)
    with ThreadPoolExecutor(4) as pool:
        orders = [np.random.default_rng(s).permutation(40).tolist() * 5 for s in range(4)]
        for order, got in zip(orders, pool.map(lambda order: [views[k] for k in order], orders), strict=True):
            assert got == [k * k for k in order]
    assert len(views._kept) <= 7


def test_preload_makes_everything_that_fits():
    made = []
    LazyViews(made.append, 9, held=6).preload(workers=3).wait()
    assert sorted(made) == [0, 1, 2, 3, 4, 5]


def test_preload_returns_at_once_and_nothing_is_made_twice():
    go, made = threading.Event(), []

    def make(k):
        assert go.wait(20)
        made.append(k)
        return -k

    views = LazyViews(make, 6)
    with views.preload(workers=2) as preloading:
        asking = ThreadPoolExecutor(1).submit(lambda: views[0])  # while another thread makes it
        assert made == []
        go.set()
        preloading.wait()
        assert asking.result() == 0
    assert sorted(made) == [0, 1, 2, 3, 4, 5]


def test_what_cannot_be_made_is_an_error_for_whoever_asks_and_is_tried_again():
    broken = {3}

    def make(k):
        if k in broken:
            raise BadInput(f"frame {k}")
        return k

    views = LazyViews(make, 5)
    with views.preload() as preloading, pytest.raises(BadInput, match="frame 3"):
        preloading.wait()
    with pytest.raises(BadInput, match="frame 3"):
        views[3]
    broken.clear()
    assert [*views] == [0, 1, 2, 3, 4]


# ------------------------------------------------------------------------------------------- hidden fraction


def test_strip_generic_hides_half_and_hardly_more(capture):
    scene = open_scene(capture, fake_protocol())
    share = scene.hiding.hidden_share()
    pooled = sum(capture.silhouette(0, k).sum(0) for k in range(8))
    columns = np.flatnonzero(scene.hiding.occlusion.hidden(0)[0])
    assert share == pytest.approx(pooled[columns].sum() / pooled.sum())
    widest = (pooled[columns[0]] + pooled[columns[-1]]) / pooled.sum()
    assert 0.5 <= share <= 0.5 + widest


def test_nothing_covered_hides_nothing():
    protocol = fake_protocol(rule="none")
    protocol = replaced(protocol, {"occlusion.covers.fraction": 0.0})
    scene = open_scene(turning_capture(), protocol)
    assert not any(scene.hiding.covered)
    assert scene.hiding.hidden_share() == 0.0


def test_names_of_test_views_sort_like_their_frames():
    assert TestViewKey(3, 30, "Camera_B4").name == "Camera_B4/000030"
