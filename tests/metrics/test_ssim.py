"""SSIM against its oracle, scikit-image and stored values; its laws; extreme inputs."""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.metrics import structural_similarity

from ihbench.metrics import ssim, ssim_map
from ihbench.metrics.oracles.oracle import ssim_map_oracle, ssim_oracle


def pair(shape, seed: int = 0, noise: float = 0.2):
    """A smooth image and a noisy copy in [0, 1], equal to each other and white in a corner block."""
    rng = np.random.default_rng(seed)
    rows = np.linspace(0, 3, shape[0])[:, None, None]
    columns = np.linspace(0, 2, shape[1])[None, :, None]
    truth = 0.5 + 0.4 * np.sin(rows + columns + np.arange(shape[2]))
    pred = np.clip(truth + noise * rng.standard_normal(shape), 0, 1)
    pred[: shape[0] // 3, : shape[1] // 2] = truth[: shape[0] // 3, : shape[1] // 2] = 1.0
    return pred, truth


def disc(shape, seed: int = 0):
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    middle = rng.uniform(0.3, 0.7, 2) * shape[:2]
    return np.hypot(rows - middle[0], columns - middle[1]) < 0.35 * min(shape[:2])


# smaller than the window, one row, one pixel, several bands of rows
SHAPES = [(1, 1, 3), (1, 30, 1), (3, 2, 3), (10, 11, 3), (19, 23, 3), (70, 9, 1)]


@pytest.fixture(autouse=True)
def small_bands(monkeypatch):
    """So that these small images are worked on in several bands."""
    # the package's attribute of the same name is the function
    monkeypatch.setattr(sys.modules["ihbench.metrics.ssim"], "BAND", 200)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 1e-10), (np.float32, 1e-5), (np.uint8, 1e-10)])
def test_equals_the_oracle(shape, dtype, tolerance):
    pred, truth = pair(shape)
    if dtype == np.uint8:
        pred, truth = np.rint(pred * 255), np.rint(truth * 255)
    oracle_in = [image.astype(dtype) for image in (pred, truth)]
    mask = disc(shape)
    np.testing.assert_allclose(ssim_map(*oracle_in), ssim_map_oracle(*oracle_in), rtol=0, atol=tolerance)
    assert ssim(*oracle_in) == pytest.approx(ssim_oracle(*oracle_in), abs=tolerance)
    assert ssim(*oracle_in, mask) == pytest.approx(ssim_oracle(*oracle_in, mask), abs=tolerance, nan_ok=True)


@pytest.mark.parametrize(
    "options",
    [
        {"window": 7, "sigma": 1.0},
        {"data_range": 2.0},
        {"window": 1},
        {"window": 7, "sigma": None, "sample": True},
        {"border": "reflect"},
        {"border": "zero"},
        {"crop": 3},
        {"window": 7, "sigma": None, "sample": True, "crop": 3, "data_range": 2.0, "background": None},
        {"background": None, "border": "zero"},
    ],
    ids=str,
)
def test_options_equal_the_oracle(options):
    pred, truth = pair((17, 14, 3))
    assert ssim(pred, truth, disc((17, 14)), **options) == pytest.approx(
        ssim_oracle(pred, truth, disc((17, 14)), **options), abs=1e-10
    )


@pytest.mark.parametrize("background", [0.0, 1.0, (0.2, 0.5, 0.9)])
def test_the_background_is_what_both_are_painted_with(background):
    pred, truth = pair((17, 14, 3))
    mask = disc((17, 14))
    painted = [np.where(mask[..., None], image, background) for image in (pred, truth)]
    expected = ssim_map_oracle(*painted)[mask].mean()
    assert ssim(pred, truth, mask, background=background) == pytest.approx(expected, abs=1e-10)
    grey = ssim(pred[..., 0], truth[..., 0], mask, background=0.3)
    assert grey == pytest.approx(ssim_oracle(pred[..., :1], truth[..., :1], mask, background=0.3), abs=1e-10)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_equals_scikit_image_away_from_the_edges(dtype):
    pred, truth = (image.astype(dtype) for image in pair((40, 50, 3)))
    # truncate 3.5 makes its window int(3.5 * 1.5 + 0.5) * 2 + 1 = 11 wide; its own float32 would not reach 1e-7
    _, reference = structural_similarity(
        pred.astype(np.float64), truth.astype(np.float64), gaussian_weights=True, sigma=1.5, truncate=3.5,
        use_sample_covariance=False, data_range=1.0, channel_axis=2, full=True,
    )  # fmt: skip
    inside = np.s_[5:-5, 5:-5]
    np.testing.assert_allclose(ssim_map(pred, truth)[inside], reference[inside], rtol=0, atol=1e-7)


def test_reference_values():
    # made with scikit-image 0.26.0 on 8-bit images padded by numpy, so that no edge rule of its own enters:
    #   rows, columns = np.mgrid[:24, :20]
    #   truth = ((rows * 7 + columns * 13) % 256).astype(np.uint8)[..., None].repeat(3, 2)
    #   pred = truth.copy(); pred[6:15, 4:12] = 255 - pred[6:15, 4:12]; pred[..., 2] //= 2
    #   x, y = (np.pad(i / 255, ((5, 5), (5, 5), (0, 0)), "symmetric") for i in (pred, truth))
    #   _, m = structural_similarity(x, y, gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
    #                                data_range=1.0, channel_axis=2, full=True)
    #   print(m[5:-5, 5:-5].mean(), m[5:-5, 5:-5].mean((0, 1)), m[5, 5], m[15, 13])
    rows, columns = np.mgrid[:24, :20]
    truth = ((rows * 7 + columns * 13) % 256).astype(np.uint8)[..., None].repeat(3, 2)
    pred = truth.copy()
    pred[6:15, 4:12] = 255 - pred[6:15, 4:12]
    pred[..., 2] //= 2
    values = ssim_map(pred, truth)
    assert ssim(pred, truth) == pytest.approx(0.6884844364243575, abs=1e-10)
    np.testing.assert_allclose(
        values.mean((0, 1)), [0.772752869974493, 0.772752869974493, 0.5199475693240863], rtol=0, atol=1e-10
    )
    np.testing.assert_allclose(values[0, 0], [1.0, 1.0, 0.6623700789845139], rtol=0, atol=1e-10)
    np.testing.assert_allclose(
        values[10, 8], [-0.4582169517824029, -0.4582169517824029, -0.2055126456043066], rtol=0, atol=1e-10
    )


def test_leaving_out_equal_windows_changes_nothing():
    truth = np.ones((200, 150, 3))
    pred = truth.copy()
    pred[30:40, 20:33] = 0.4
    pred[150:153, 140:] = 0.1
    noisy = np.nextafter(pred, 0)  # differs everywhere, by one bit
    np.testing.assert_allclose(ssim_map(pred, truth), ssim_map(noisy, truth), rtol=0, atol=1e-12)
    values = ssim_map(pred, truth)
    assert (values < 1).any()
    assert ssim(pred, truth) == pytest.approx(values.mean(), abs=1e-14)


@given(st.integers(0, 10_000))
@settings(deadline=None, derandomize=True, max_examples=40)
def test_nothing_outside_the_mask_leaks_in(seed):
    rng = np.random.default_rng(seed)
    shape = (*rng.integers(2, 40, 2), 3)
    pred, truth = pair(shape, seed)
    mask = rng.random(shape[:2]) < rng.uniform(0.05, 0.95)
    mask[0, 0] = True
    value = ssim(pred, truth, mask)
    for image in (pred, truth):
        image[~mask] = rng.choice([np.nan, np.inf, 0.0, 1e30, 0.5], size=image[~mask].shape)
    assert ssim(pred, truth, mask) == pytest.approx(value, abs=1e-13)
    assert ssim(truth, pred, mask) == pytest.approx(value, abs=1e-13)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("both", [True, False])
def test_a_bad_pixel_inside_makes_the_score_nan(bad, both):
    pred, truth = pair((20, 20, 3))
    pred[9, 9, 0] = bad
    if both:
        truth[9, 9, 0] = bad
    mask = np.zeros((20, 20), bool)
    mask[9:12, 9:12] = True
    assert math.isnan(ssim(pred, truth))
    assert math.isnan(ssim(pred, truth, mask))
    values = ssim_map(pred, truth)
    assert np.isnan(values[4:15, 4:15, 0]).all()
    assert np.isfinite(values[..., 1:]).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_bad_pixels_that_agree_are_not_taken_for_equal_windows(bad):
    image = pair((20, 20, 3))[0]
    image[9, 9, 0] = bad
    assert math.isnan(ssim(image, image.copy()))


@pytest.mark.parametrize("where", [(0, 0), (7, 3), (19, 19)])
def test_a_mask_of_one_pixel(where):
    pred, truth = pair((20, 20, 3), noise=0.4)
    mask = np.zeros((20, 20), bool)
    mask[where] = True
    assert ssim(pred, truth, mask) == pytest.approx(ssim_oracle(pred, truth, mask), abs=1e-10)


@pytest.mark.parametrize("mean", [0.0, 0.5, 0.9, 1.0])
@pytest.mark.parametrize("sigma", [1e-7, 1e-5, 1e-3])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_tiny_variance_on_a_large_mean(mean, sigma, dtype):
    rng = np.random.default_rng(1)
    pred, truth = ((mean + sigma * rng.standard_normal((16, 16, 1))).astype(dtype) for _ in range(2))
    np.testing.assert_allclose(ssim_map(pred, truth, hdr=True), ssim_map_oracle(pred, truth), rtol=0, atol=1e-12)


def test_values_far_outside_the_range_stay_accurate():
    pred, truth = (1e4 * image for image in pair((16, 16, 1)))
    np.testing.assert_allclose(ssim_map(pred, truth, hdr=True), ssim_map_oracle(pred, truth), rtol=0, atol=1e-6)


def test_a_larger_range_is_a_more_lenient_score():
    pred, truth = pair((40, 40, 3))
    assert ssim(pred, truth, data_range=2.0) > ssim(pred, truth, data_range=1.0)


@given(st.integers(0, 10_000), st.floats(0, 1))
@settings(deadline=None, derandomize=True, max_examples=30)
def test_bounds_and_symmetries(seed, noise):
    pred, truth = pair((24, 18, 3), seed, noise)
    value = ssim(pred, truth)
    assert -1 <= value <= 1
    assert ssim(truth, pred) == pytest.approx(value, abs=1e-13)
    assert ssim(pred[::-1], truth[::-1]) == pytest.approx(value, abs=1e-12)  # also: views that are not contiguous
    assert ssim(pred.swapaxes(0, 1), truth.swapaxes(0, 1)) == pytest.approx(value, abs=1e-12)


@pytest.mark.parametrize("options", [{"window": 10}, {"window": 0}, {"sigma": 0.0}, {"sigma": math.nan}])
def test_a_window_without_a_centre_or_width_is_refused(options):
    with pytest.raises(ValueError, match="window"):
        ssim(np.zeros((4, 4)), np.zeros((4, 4)), **options)
