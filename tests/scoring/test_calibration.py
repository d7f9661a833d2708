"""Calibration rows: each is exactly the trivial prediction that it says it is."""

from dataclasses import replace

import numpy as np
import pytest

from ihbench.metrics import psnr
from ihbench.scene.contracts import MaskState, TrainingSet
from ihbench.scoring.calibration import DESCRIPTIONS, ROWS, Calibration
from tests.bench.fake_capture import SIZE, WHITE, a_camera, a_pose, rasterized, the_body, train_view, truth_view

BODY = the_body()
CENTRE = slice(SIZE // 2 - 4, SIZE // 2 + 4)
HEADINGS = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)
BLUE = (0.2, 0.4, 1.0)


def calibration(views, background=WHITE):
    return Calibration.build(TrainingSet(views, BODY, background, "calibration"))


@pytest.fixture(scope="module")
def views():
    return [train_view(a_camera(), a_pose(heading), CENTRE, frame=k) for k, heading in enumerate(HEADINGS)]


@pytest.fixture(scope="module")
def rows(views):
    return calibration(views)


def eroded(mask):
    inner = mask.copy()
    for axis in (0, 1):
        for step in (-1, 1):
            inner &= np.roll(mask, step, axis)
    return inner


def test_every_row_has_a_description_and_a_picture(rows):
    view = truth_view(a_camera(0.5), a_pose())
    assert set(DESCRIPTIONS) == set(ROWS)
    for row in ROWS:
        image = rows.predict(row, view)
        assert image.dtype == np.float32
        assert image.shape == (SIZE, SIZE, 3)
        assert 0 <= image.min() < image.max() <= 1
    with pytest.raises(ValueError, match=r"'truht'.*pasted-texture"):
        rows.predict("truht", view)


def test_truth_rows_are_the_truth(rows):
    view = truth_view(a_camera(0.5), a_pose())
    assert rows.predict("truth", view) is view.image
    assert np.array_equal(rows.predict("truth-8bit", view), view.image)
    fine = replace(view, image=np.random.default_rng(0).uniform(0, 1, view.image.shape).astype(np.float32))
    rounded = rows.predict("truth-8bit", fine)
    assert 0 < np.abs(rounded - fine.image).max() <= 0.5 / 255 + 1e-7
    np.testing.assert_allclose(rounded * 255, np.round(rounded * 255), atol=1e-4)


def test_mean_colour_is_the_mean_over_visible_person_pixels(views, rows):
    pixels = np.concatenate([view.image[view.mask == MaskState.PERSON] for view in views]) / 255
    np.testing.assert_allclose(rows.mean_color, pixels.mean(0), atol=1e-6)


def test_nothing_but_visible_person_pixels_counts(views, rows):
    """Other colours behind the occluder and in the background change no row but the pasted photograph itself."""
    dirty = [
        replace(view, image=np.where((view.mask == MaskState.PERSON)[..., None], view.image, np.uint8(0)))
        for view in views
    ]
    other = calibration(dirty)
    assert np.array_equal(other.mean_color, rows.mean_color)
    assert np.array_equal(other.texture, rows.texture)


def test_mean_colour_body_is_the_body_in_one_colour(views):
    row = calibration(views, BLUE)
    view = truth_view(a_camera(0.5), a_pose(0.3, 0.5))
    image = row.predict("mean-colour-body", view)
    body = rasterized(view.camera, view.body_pose).mask
    inside, outside = eroded(body), eroded(~body)
    assert np.isclose(image[inside], row.mean_color, atol=1e-6).all(1).mean() > 0.995  # but for gaps below a pixel
    assert np.isclose(image[outside], BLUE, atol=1e-6).all(1).mean() > 0.995
    share = (image[..., 0] - BLUE[0]) / (row.mean_color[0] - BLUE[0])  # what of a pixel the body covers
    assert abs(share.sum() - body.sum()) < 0.02 * body.sum()
    assert len(np.unique(share.round(3))) == 5  # twice the size: quarters


def test_a_training_view_pasted_and_drawn_again_is_itself():
    size = 192
    view = train_view(a_camera(0.4, size), a_pose(0.2, 0.3))
    row = calibration([view])
    inside = eroded(eroded(view.mask == MaskState.PERSON))
    truth = truth_view(view.camera, view.body_pose)
    assert psnr(row.predict("pasted-texture", truth), truth.image, inside) > 40
    assert psnr(row.predict("mean-colour-body", truth), truth.image, inside) < 20


def test_pasted_texture_follows_the_pose_and_knows_no_more_than_was_seen(views, rows):
    """Another pose and camera: right where something was seen of the texel, the mean colour where nothing was."""
    view = truth_view(a_camera(2.2), a_pose(-0.5, 0.5))
    image = rows.predict("pasted-texture", view)
    inside = eroded(view.silhouette)
    assert psnr(image, view.image, inside) > psnr(rows.predict("mean-colour-body", view), view.image, inside) + 4
    one = calibration(views[:1])
    behind = one.predict("pasted-texture", truth_view(a_camera(np.pi), a_pose()))
    back = eroded(eroded(rasterized(a_camera(np.pi), a_pose()).mask))
    assert np.isclose(behind[back], one.mean_color, atol=1e-3).all(1).mean() > 0.98


def test_texture_is_the_mean_over_the_views_that_saw_a_texel():
    """The same view in two brightnesses."""
    view = train_view(a_camera(), a_pose())
    dark = replace(view, image=view.image // 3)
    bright, both = calibration([view]), calibration([view, dark, dark])
    expected = (bright.texture + 2 * calibration([dark]).texture) / 3
    np.testing.assert_allclose(both.texture, expected, atol=1e-6)


@pytest.mark.parametrize("wanted", range(len(HEADINGS)))
def test_the_nearest_frame_is_the_one_with_the_nearest_view_of_the_body(views, rows, wanted):
    """A camera that goes round an unturned person sees what camera 0 saw of the turned one."""
    view = truth_view(a_camera(-HEADINGS[wanted] + 0.2), a_pose())
    image = rows.predict("nearest-frame", view)
    errors = [np.abs(calibration([v]).predict("nearest-frame", view) - image).max() for v in views]
    assert errors[wanted] == 0
    assert min(errors[:wanted] + errors[wanted + 1 :]) > 0.1


def test_the_nearest_frame_prefers_the_nearest_pose():
    straight, bent = (train_view(a_camera(), a_pose(0, arms)) for arms in (0.0, 1.0))
    row = calibration([straight, bent])
    for view, arms in ((straight, 0.2), (bent, 0.8)):
        alone = calibration([view])
        test = truth_view(a_camera(), a_pose(0, arms))
        assert np.array_equal(row.predict("nearest-frame", test), alone.predict("nearest-frame", test))


def test_the_training_view_itself_comes_back_unmoved(views, rows):
    view = truth_view(views[0].camera, views[0].body_pose)
    np.testing.assert_allclose(rows.predict("nearest-frame", view), views[0].image / 255, atol=2e-5)


@pytest.mark.parametrize(
    ("distance", "transl"), [(6.0, (0, 0, 0)), (2.8, (0.1, 0.05, 0.1)), (4.0, (-0.6, 0.3, 0))], ids=str
)
def test_the_nearest_frame_is_moved_to_the_box_of_the_body(distance, transl):
    source = train_view(a_camera(), a_pose(0, 0.4))
    view = truth_view(a_camera(0.0, SIZE, distance), a_pose(0, 0.4, transl))
    image = calibration([source]).predict("nearest-frame", view)
    rows, cols = np.nonzero((image < 0.9).any(-1))
    body = rasterized(view.camera, view.body_pose).mask
    for got, expected in zip((rows, cols), np.nonzero(body), strict=True):
        assert abs(got.min() - expected.min()) <= 1.5
        assert abs(got.max() - expected.max()) <= 1.5
    assert (image[eroded(~body)] > 0.9).all(1).mean() > 0.97


def test_outside_the_photograph_is_background():
    source = train_view(a_camera(distance=2.0), a_pose())  # the body fills the image and more
    row = calibration([replace(source, image=np.zeros_like(source.image))], BLUE)
    image = row.predict("nearest-frame", truth_view(a_camera(distance=8.0), a_pose()))
    np.testing.assert_allclose(image[0, 0], BLUE, atol=1e-6)
    assert image.min() < 1e-6
