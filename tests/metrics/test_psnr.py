"""PSNR against its oracle, its laws, and the cases where it is not a number."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from ihbench.metrics import psnr
from ihbench.metrics.oracles.oracle import psnr_oracle

rng = np.random.default_rng(0)


@pytest.mark.parametrize("shape", [(1, 1, 1), (9, 7, 3), (5, 8, 3)])
@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.uint8])
def test_equals_the_oracle(shape, dtype):
    pred, truth = rng.random(shape), rng.random(shape)
    mask = rng.random(shape[:2]) < 0.6
    mask[0, 0] = True
    if dtype == np.uint8:
        pred, truth = pred * 255, truth * 255
    pred, truth = pred.astype(dtype), truth.astype(dtype)
    assert psnr(pred, truth) == pytest.approx(psnr_oracle(pred, truth), abs=1e-10)
    assert psnr(pred, truth, mask) == pytest.approx(psnr_oracle(pred, truth, mask), abs=1e-10)


def test_a_constant_error_of_a_tenth_is_20_db():
    truth = rng.random((6, 6, 3)) * 0.9
    assert psnr(truth + 0.1, truth) == pytest.approx(20.0, abs=1e-12)


def test_channels_are_pooled_not_averaged_in_db():
    # channel errors .002 .004 .010 pool to 22.73 dB; the mean of the three channels' PSNRs would be 23.66
    truth = np.zeros((4, 4, 3))
    pred = truth + np.sqrt([0.002, 0.004, 0.010])
    assert psnr(pred, truth) == pytest.approx(-10 * math.log10(0.016 / 3), abs=1e-12)
    assert round(psnr(pred, truth), 2) == 22.73


@pytest.mark.parametrize("sign", [1, -1])
def test_8_bit_differences_do_not_wrap(sign):
    dark, light = np.zeros((2, 2, 3), np.uint8), np.full((2, 2, 3), 255, np.uint8)
    assert psnr(*(dark, light)[::sign]) == 0.0


def test_identical_is_infinite_and_empty_is_nan():
    image = rng.random((4, 4, 3))
    assert psnr(image, image.copy()) == math.inf
    assert math.isnan(psnr(image, image, np.zeros((4, 4), bool)))
    assert math.isnan(psnr(np.zeros((0, 4, 3)), np.zeros((0, 4, 3))))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("both", [True, False])
@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.float16])
def test_a_bad_pixel_counts_only_inside_the_mask(bad, both, dtype):
    pred, truth = rng.random((2, 5, 5, 3)).astype(dtype)
    pred[2, 2, 1] = bad
    if both:
        truth[2, 2, 1] = bad
    mask = np.ones((5, 5), bool)
    assert math.isnan(psnr(pred, truth, mask))
    mask[2, 2] = False
    clean = psnr(pred, truth, mask)
    pred[2, 2] = truth[2, 2] = 0.5
    assert clean == pytest.approx(psnr(pred, truth, mask), abs=1e-12)


def test_half_precision_is_accumulated_in_double():
    truth = np.zeros((256, 256, 3), np.float16)
    assert psnr(truth + np.float16(0.5), truth) == pytest.approx(-20 * math.log10(0.5), abs=1e-12)


@given(
    arrays.arrays(np.uint8, (6, 5, 3)),
    arrays.arrays(np.uint8, (6, 5, 3)),
    arrays.arrays(np.bool_, (6, 5)),
    st.integers(),
)
@settings(deadline=None, derandomize=True)
def test_laws(pred, truth, mask, seed):
    value = psnr(pred, truth, mask)
    if not mask.any():
        assert math.isnan(value)
        return
    assert psnr(truth, pred, mask) == value  # symmetric
    noise = np.random.default_rng(abs(seed)).integers(0, 256, pred.shape, dtype=np.uint8)
    assert psnr(np.where(mask[..., None], pred, noise), truth, mask) == value  # blind to what is outside
    order = np.random.default_rng(abs(seed)).permutation(30)
    shuffled = [image.reshape(30, 1, 3)[order] for image in (pred, truth)]
    assert psnr(*shuffled, mask.reshape(30, 1)[order]) == value  # to the last bit: sums are integers


def test_error_confined_to_a_region_shifts_the_full_score_by_its_area():
    truth = rng.random((40, 50, 3))
    pred, mask = truth.copy(), np.zeros((40, 50), bool)
    mask[5:25, 10:35] = True
    pred[mask] += 0.05 * rng.standard_normal((500, 3))
    assert psnr(pred, truth) - psnr(pred, truth, mask) == pytest.approx(-10 * math.log10(500 / 2000), abs=1e-10)


@pytest.mark.parametrize(
    ("pred", "truth", "mask", "words"),
    [
        (np.zeros((4, 4, 3)), np.zeros((4, 5, 3)), None, r"\(4, 4, 3\).*\(4, 5, 3\)"),
        (np.zeros((4, 4, 3)), np.zeros((4, 4, 3), np.uint8), None, "float64.*uint8"),
        (np.zeros((4, 4, 3), np.int64), np.zeros((4, 4, 3), np.int64), None, "int64"),
        (np.zeros(4), np.zeros(4), None, r"\(4,\)"),
        (np.zeros((4, 4, 3)), np.zeros((4, 4, 3)), np.ones((4, 5), bool), r"mask.*\(4, 4\).*\(4, 5\)"),
        (np.zeros((4, 4, 3)), np.zeros((4, 4, 3)), np.ones((4, 4), np.uint8), "mask.*bool.*uint8"),
        ([[0.5]], np.zeros((1, 1)), None, "pred.*list"),
    ],
)
def test_what_cannot_be_compared_is_refused(pred, truth, mask, words):
    with pytest.raises(ValueError, match=words):
        psnr(pred, truth, mask)
