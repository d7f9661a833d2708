"""FLIP against its oracle, NVIDIA's evaluator and stored values; its laws; extreme inputs."""

from __future__ import annotations

import importlib
import math
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import flip_evaluator
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ihbench.metrics.flip import PPD, Filters, flip, flip_map, mean_flip
from ihbench.metrics.images import differing_pixels
from ihbench.metrics.oracles.flip_oracle import flip_map_oracle, flip_oracle

# NVIDIA's evaluator computes in float32. On flat patches its edge filters leave rounding errors of 1e-7, and the
# square root in the feature difference turns them into 3e-4, which moves the map by up to a third of that.
FLOAT32 = 2e-4


def pair(shape, seed: int = 0, noise: float = 0.2):
    """A smooth image and a noisy copy in [0, 1], equal to each other and white in a corner block."""
    rng = np.random.default_rng(seed)
    rows = np.linspace(0, 3, shape[0])[:, None, None]
    columns = np.linspace(0, 2, shape[1])[None, :, None]
    truth = 0.5 + 0.4 * np.sin(rows + columns + np.arange(3))
    pred = np.clip(truth + noise * rng.standard_normal((*shape, 3)), 0, 1)
    pred[: shape[0] // 3, : shape[1] // 2] = truth[: shape[0] // 3, : shape[1] // 2] = 1.0
    return pred, truth


def disc(shape, seed: int = 0):
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    middle = rng.uniform(0.3, 0.7, 2) * shape
    return np.hypot(rows - middle[0], columns - middle[1]) < 0.35 * min(shape)


def of_dtype(images, dtype):
    return [(np.rint(image * 255) if dtype == np.uint8 else image).astype(dtype) for image in images]


def official(pred, truth, ppd=PPD):
    """[H, W] map of NVIDIA's evaluator."""
    images = [(image / 255 if image.dtype == np.uint8 else image).astype(np.float32) for image in (truth, pred)]
    return flip_evaluator.evaluate(*images, "LDR", applyMagma=False, parameters={"ppd": ppd})[0][..., 0]


# one pixel, one row or column, smaller than the filters
SHAPES = [(1, 1), (1, 30), (25, 1), (3, 2), (10, 11), (37, 29), (14, 90)]


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("dtype", [np.uint8, np.float64, np.float32, np.float16])
def test_equals_the_oracle(shape, dtype):
    tolerance = 1e-10
    pred, truth = of_dtype(pair(shape), dtype)
    mask = disc(shape)
    expected = flip_map_oracle(pred, truth)
    np.testing.assert_allclose(flip_map(pred, truth), expected, rtol=0, atol=tolerance)
    assert flip(pred, truth) == pytest.approx(expected.mean(), abs=tolerance)
    assert flip(pred, truth, mask) == pytest.approx(flip_oracle(pred, truth, mask), abs=tolerance, nan_ok=True)


@pytest.mark.parametrize("ppd", [1.0, 11.3, 40.0, 130.0])
def test_other_pixels_per_degree_equal_the_oracle(ppd):
    pred, truth = pair((31, 23))
    np.testing.assert_allclose(flip_map(pred, truth, ppd=ppd), flip_map_oracle(pred, truth, ppd), rtol=0, atol=1e-10)
    assert flip(pred, truth, disc((31, 23)), ppd=ppd) == pytest.approx(
        flip_oracle(pred, truth, disc((31, 23)), ppd=ppd), abs=1e-10
    )


@pytest.mark.parametrize("background", [0.0, 0.3, (0.2, 0.5, 0.9)])
@pytest.mark.parametrize("dtype", [np.uint8, np.float64])
def test_the_background_is_what_both_are_painted_with(background, dtype):
    pred, truth = of_dtype(pair((37, 34)), dtype)
    mask = disc((37, 34))
    value = flip(pred, truth, mask, background=background)
    assert value == pytest.approx(flip_oracle(pred, truth, mask, background), abs=1e-10)
    peak = 255 if dtype == np.uint8 else 1
    painted = [np.where(mask[..., None], image / peak, background) for image in (pred, truth)]
    assert value == pytest.approx(flip_map(*painted)[mask].mean(), abs=1e-12)


def test_bands_of_rows_meet_without_a_seam(monkeypatch):
    pred, truth = pair((250, 12))
    whole, mask = flip_map(pred, truth), disc((250, 12))
    values = flip(pred, truth), flip(pred, truth, mask)
    module = importlib.import_module("ihbench.metrics.flip")
    monkeypatch.setattr(module, "BAND", 1)
    assert len(list(module._bands(differing_pixels(pred, truth), None, Filters.of(PPD).radius))) > 2
    np.testing.assert_allclose(flip_map(pred, truth), whole, rtol=0, atol=1e-13)
    assert (flip(pred, truth), flip(pred, truth, mask)) == pytest.approx(values, abs=1e-13)


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (9, 12), (60, 70)])
@pytest.mark.parametrize("ppd", [PPD, 30.0])
def test_equals_the_official_evaluator(shape, ppd):
    pred, truth = pair(shape)
    np.testing.assert_allclose(flip_map(pred, truth, ppd=ppd), official(pred, truth, ppd), rtol=0, atol=FLOAT32)


def test_default_viewing_distance_is_the_official_one():
    images = [image.astype(np.float32) for image in pair((4, 4))]
    parameters = flip_evaluator.evaluate(*images, "LDR")[2]
    assert pytest.approx(parameters["ppd"], rel=1e-6) == PPD


def test_reference_values():
    # made with flip-evaluator 1.7 (float32, hence the tolerances):
    #   rows, columns = np.mgrid[:24, :20]
    #   truth = np.stack([(rows * 7 + columns * 13 + 80 * c) % 256 for c in range(3)], -1).astype(np.uint8)
    #   pred = truth.copy(); pred[6:15, 4:12] = 255 - pred[6:15, 4:12]; pred[..., 2] //= 2
    #   m, mean, _ = flip_evaluator.evaluate((truth / 255).astype(np.float32), (pred / 255).astype(np.float32),
    #                                        "LDR", applyMagma=False)
    #   print(mean, [m[i, j, 0] for i, j in ((0, 0), (10, 8), (5, 3), (23, 19))])
    rows, columns = np.mgrid[:24, :20]
    truth = np.stack([(rows * 7 + columns * 13 + 80 * c) % 256 for c in range(3)], -1).astype(np.uint8)
    pred = truth.copy()
    pred[6:15, 4:12] = 255 - pred[6:15, 4:12]
    pred[..., 2] //= 2
    values = flip_map(pred, truth)
    assert flip(pred, truth) == pytest.approx(0.65293729, abs=2e-6)
    np.testing.assert_allclose(
        [values[0, 0], values[10, 8], values[5, 3], values[23, 19]],
        [0.6416464, 0.635556, 0.753303, 0.3407532],
        rtol=0,
        atol=2e-5,
    )


def test_the_ends_of_the_scale():
    black, white = np.zeros((30, 30, 3), np.uint8), np.full((30, 30, 3), 255, np.uint8)
    # lightness alone makes black and white the largest difference of greys, but green and blue are further apart
    assert flip(black, white) == pytest.approx(0.9673797614921328, abs=1e-12)
    green, blue = black.copy(), black.copy()
    green[..., 1] = blue[..., 2] = 255
    assert flip(green, blue) == pytest.approx(1.0, abs=1e-12)


def test_leaving_out_equal_windows_changes_nothing():
    truth = pair((120, 90))[1]
    pred = truth.copy()
    pred[30:40, 20:33] = 0.4
    pred[100:103, 85:] = 0.1
    values = flip_map(pred, truth)
    expected = flip_map_oracle(pred, truth)
    # in the outermost pixels what the filters leave of the difference is itself about a rounding error
    clear = expected > 1e-5
    np.testing.assert_allclose(values[clear], expected[clear], rtol=0, atol=1e-10)
    np.testing.assert_allclose(values, expected, rtol=0, atol=1e-8)
    assert flip(pred, truth) == pytest.approx(expected.mean(), abs=1e-10)
    near = np.zeros((120, 90), bool)
    near[20:50, 10:43] = near[90:113, 75:] = True  # 10 px: the filters' reach
    assert (values[~near] == 0).all()
    assert (values[30:40, 20:33] > 0).all()
    assert flip(pred, truth) == pytest.approx(values.mean(), abs=1e-14)


def test_flat_patches_have_no_feature_at_any_column():
    # a rounding error of 1e-17 that differs from one column to the next would show as 1e-9
    rng = np.random.default_rng(3)
    for _ in range(20):
        x, y = rng.random((2, 3))
        height, width = rng.integers(1, 60, 2)
        values = flip_map(np.broadcast_to(x, (height, width, 3)), np.broadcast_to(y, (height, width, 3)))
        assert np.ptp(values) < 1e-13


@given(st.integers(0, 10_000))
@settings(deadline=None, derandomize=True, max_examples=40)
def test_nothing_outside_the_mask_leaks_in(seed):
    rng = np.random.default_rng(seed)
    shape = tuple(rng.integers(2, 40, 2))
    pred, truth = pair(shape, seed)
    mask = rng.random(shape) < rng.uniform(0.05, 0.95)
    mask[0, 0] = True
    value = flip(pred, truth, mask)
    assert 0 < value <= 1 or (pred[mask] == truth[mask]).all()
    for image in (pred, truth):
        image[~mask] = rng.choice([np.nan, np.inf, -np.inf, 0.0, 1e30, 0.5], size=image[~mask].shape)
    assert flip(pred, truth, mask) == pytest.approx(value, abs=1e-14)
    assert flip(truth, pred, mask) == pytest.approx(value, abs=1e-14)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.float16])
@pytest.mark.parametrize("where", ["pred", "truth", "both"])
def test_a_bad_pixel_inside_makes_the_score_nan(bad, dtype, where):
    images = dict(zip(("pred", "truth"), of_dtype(pair((40, 40)), dtype), strict=True))
    clean = flip_map(**images)
    for name, image in images.items():
        if where in (name, "both"):
            image[20, 21, 0] = bad
    mask = np.zeros((40, 40), bool)
    mask[20:22, 20:22] = True
    assert math.isnan(flip(**images))
    assert math.isnan(flip(**images, mask=mask))
    mask[20, 21] = False
    assert math.isfinite(flip(**images, mask=mask))
    values = flip_map(**images)
    met = np.zeros((40, 40), bool)
    met[10:31, 11:32] = True
    assert np.isnan(values[met]).all()
    np.testing.assert_allclose(values[~met], clean[~met], rtol=0, atol=1e-13)


def test_empty_mask_and_empty_image_are_nan():
    pred, truth = pair((8, 8))
    assert math.isnan(flip(pred, truth, np.zeros((8, 8), bool)))
    assert math.isnan(flip(np.zeros((0, 3, 3)), np.zeros((0, 3, 3))))
    assert flip_map(np.zeros((0, 3, 3)), np.zeros((0, 3, 3))).shape == (0, 3)


@pytest.mark.parametrize("where", [(0, 0), (0, 19), (23, 0), (23, 19), (7, 3)])
@pytest.mark.parametrize("background", [1.0, 0.0])
def test_a_mask_of_one_pixel(where, background):
    pred, truth = pair((24, 20), noise=0.4)
    pred[where] = 0.1, 0.8, 0.4
    mask = np.zeros((24, 20), bool)
    mask[where] = True
    value = flip(pred, truth, mask, background=background)
    assert value == pytest.approx(flip_oracle(pred, truth, mask, background), abs=1e-10)
    assert value > 0.05


@given(st.integers(0, 10_000), st.floats(0, 1))
@settings(deadline=None, derandomize=True, max_examples=30)
def test_bounds_and_symmetries(seed, noise):
    pred, truth = pair((24, 18), seed, noise)
    value = flip(pred, truth)
    assert 0 <= value <= 1
    assert flip(truth, pred) == value
    assert flip(pred[::-1], truth[::-1]) == pytest.approx(value, abs=1e-9)  # also: views that are not contiguous
    assert flip(pred[:, ::-1], truth[:, ::-1]) == pytest.approx(value, abs=1e-9)
    assert flip(pred.swapaxes(0, 1), truth.swapaxes(0, 1)) == pytest.approx(value, abs=1e-9)


def test_differing_pixels_can_be_shared_and_threads_do_not_disturb_each_other():
    pairs = [pair((60 + 7 * k, 50), seed=k) for k in range(6)]
    expected = [flip(*images, disc(images[0].shape[:2])) for images in pairs]

    def one(images):
        mask = disc(images[0].shape[:2])
        return [mean_flip(*images, differing_pixels(*images), mask, 1.0) for _ in range(5)]

    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(one, pairs)) == [[value] * 5 for value in expected]


def test_importing_it_costs_numpy_only():
    heavy = "numba", "cv2", "torch", "scipy"
    code = f"import sys, ihbench.metrics.flip; print([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("ppd", [0.0, -3.0, 0.5, math.inf, math.nan])
def test_too_few_pixels_per_degree_are_refused(ppd):
    with pytest.raises(ValueError, match="pixel per degree"):
        flip(np.zeros((4, 4, 3)), np.ones((4, 4, 3)), ppd=ppd)
