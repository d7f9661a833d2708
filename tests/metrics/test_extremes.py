"""The extreme set: every metric in every dtype gives the answer that ihbench/metrics/README.md promises, quietly."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest
import torch

from ihbench import registry
from ihbench.metrics import psnr, ssim
from ihbench.metrics.evaluate import evaluate
from ihbench.metrics.flip import flip
from ihbench.metrics.lpips import lpips, random_networks

DTYPES = ("uint8", "float16", "float32", "float64", "bfloat16")
FLOATS = DTYPES[1:]
PERFECT = {"psnr": math.inf, "ssim": 1.0, "flip": 0.0, "lpips": 0.0}
METRICS = {"psnr": psnr, "ssim": ssim, "flip": flip, "lpips": lpips}


@pytest.fixture(autouse=True)
def no_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


@pytest.fixture(autouse=True, scope="module")
def networks():
    with random_networks():
        yield


def as_type(image, dtype):
    """[H, W, 3] of whole 8-bit levels over 255, in a dtype; bfloat16 is a tensor."""
    if dtype == "bfloat16":
        return torch.from_numpy(np.asarray(image, np.float32)).bfloat16()
    return np.rint(image * 255).astype(np.uint8) if dtype == "uint8" else np.asarray(image, dtype)


def as_float64(image):
    image = image.float().numpy() if isinstance(image, torch.Tensor) else image
    return image / 255 if image.dtype == np.uint8 else image.astype(np.float64)


def texture(height, width, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3)) / 255


def all_of(pred, truth, mask=None, but=(), hdr=False):
    """Every metric's value; LPIPS has the frame as its crop."""
    found = {
        name: metric(pred, truth, mask, hdr=hdr) for name, metric in METRICS.items() if name not in (*but, "lpips")
    }
    if "lpips" not in but:
        found["lpips"] = lpips(pred, truth)
    return found


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("size", [(1, 1), (1, 7), (5, 3), (33, 20)])
def test_identical(size, dtype):
    image = as_type(texture(*size), dtype)
    assert all_of(image, image) == PERFECT


@pytest.mark.parametrize("dtype", DTYPES)
def test_one_step_of_one_value(dtype):
    truth = as_type(np.full((24, 24, 3), 128 / 255), dtype)
    pred = truth.clone() if dtype == "bfloat16" else truth.copy()
    if dtype == "uint8":
        pred[3, 4, 1] += 1
    elif dtype == "bfloat16":
        pred[3, 4, 1] = torch.nextafter(pred[3, 4, 1], torch.tensor(1.0, dtype=torch.bfloat16))
    else:
        pred[3, 4, 1] = np.nextafter(pred[3, 4, 1], pred.dtype.type(1))
    step = abs(as_float64(pred) - as_float64(truth)).max()
    assert step > 0
    found = all_of(pred, truth)
    assert found["psnr"] == pytest.approx(-10 * math.log10(step**2 / (24 * 24 * 3)), rel=1e-12)
    # where the step is far below float64's resolution of 1 the score may be the perfect one
    assert 1 - step <= found["ssim"] <= 1
    assert (found["ssim"] < 1) == (step > 1e-8)
    assert 0 <= found["flip"] < 0.05
    assert 0 <= found["lpips"] < 1e-2


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("size", [(1, 1), (3, 2), (40, 40)])
def test_constant_images_have_a_closed_form(size, dtype):
    x, y = (as_type(np.full((*size, 3), level / 255), dtype) for level in (60, 180))
    a, b = as_float64(x)[0, 0, 0], as_float64(y)[0, 0, 0]
    found = all_of(x, y)
    assert found["psnr"] == pytest.approx(-20 * math.log10(b - a), rel=1e-12)
    assert found["ssim"] == pytest.approx((2 * a * b + 1e-4) / (a * a + b * b + 1e-4), rel=1e-12)
    assert 0 < found["flip"] < 1
    assert found["lpips"] > 0


@pytest.mark.parametrize("dtype", DTYPES)
def test_an_empty_mask_is_nan_and_a_mask_of_one_pixel_counts_it(dtype):
    x, y = as_type(texture(20, 20), dtype), as_type(texture(20, 20, 1), dtype)
    empty, one = np.zeros((20, 20), bool), np.zeros((20, 20), bool)
    one[0, 19] = True
    assert all(math.isnan(v) for v in all_of(x, y, empty, but=["lpips"]).values())
    found = all_of(x, y, one, but=["lpips"])
    error = np.square(as_float64(x) - as_float64(y))[0, 19].mean()
    assert found["psnr"] == pytest.approx(-10 * math.log10(error), rel=1e-12)
    assert 0 < found["ssim"] < 1
    assert 0 < found["flip"] < 1


@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_pixel_that_is_not_finite_is_nan_where_it_counts(bad, dtype):
    x, y = as_type(texture(70, 70), dtype), as_type(texture(70, 70, 1), dtype)
    x[5, 6, 1] = bad
    far = np.zeros((70, 70), bool)
    far[40:, 40:] = True
    assert all(math.isnan(v) for v in all_of(x, y).values())
    clean = as_type(texture(70, 70), dtype)
    assert all_of(x, y, far, but=["lpips"]) == all_of(clean, y, far, but=["lpips"])


@pytest.mark.parametrize("dtype", FLOATS)
def test_hdr_counts_as_it_is_and_is_clipped_where_a_display_is_meant(dtype):
    x, y = as_type(texture(24, 24) * 100, dtype), as_type(texture(24, 24, 1), dtype)
    error = np.square(as_float64(x) - as_float64(y)).mean()
    found = all_of(x, y, but=["lpips"], hdr=True)
    assert found["psnr"] == pytest.approx(-10 * math.log10(error), rel=1e-12)
    assert -1 <= found["ssim"] <= 1
    assert found["flip"] == pytest.approx(flip(x.clip(0, 1), y), abs=1e-12)
    largest = as_type(np.full((12, 12, 3), 6e4), dtype)  # its square is beyond float16
    assert math.isfinite(psnr(largest, as_type(np.zeros((12, 12, 3)), dtype), hdr=True))
    for name in registry.names("metric preset"):
        assert evaluate(x, y, preset=name, hdr=True)
    for metric in (*METRICS.values(), evaluate):
        with pytest.raises(ValueError, match="hdr=True"):
            metric(x, y)


@pytest.mark.parametrize("dtype", DTYPES)
def test_tiny_variance_on_a_large_mean(dtype):
    """Two unrelated patterns of one level, on 250: what is left of a variance in float32 is mostly rounding."""
    levels = 250 + np.random.default_rng(0).integers(0, 2, (2, 40, 40, 3))
    x, y = (as_type(level / 255, dtype) for level in levels)
    a, b = as_float64(x), as_float64(y)
    from ihbench.metrics.oracles.oracle import ssim_oracle

    assert ssim(x, y) == pytest.approx(ssim_oracle(a[:16, :16], b[:16, :16]), abs=0.05)
    assert ssim(x[:16, :16], y[:16, :16]) == pytest.approx(ssim_oracle(a[:16, :16], b[:16, :16]), abs=1e-10)


@pytest.mark.parametrize("dtype", DTYPES)
def test_8192_by_8192(dtype):
    """A block of 64² differs in a frame of 67 million pixels (of single precision; else of 4): closed forms, and
    what the block alone gives."""
    size = 8192 if dtype == "float32" else 2048
    half = size // 2
    level = as_type(np.full((1, 1, 3), 128 / 255), dtype)
    truth = level.expand(size, size, 3).clone() if dtype == "bfloat16" else np.full((size, size, 3), level[0, 0, 0])
    small = truth[:256, :256]
    pred = truth.clone() if dtype == "bfloat16" else truth.copy()
    pred[half : half + 64, half : half + 64] = 0
    near = pred[half - 96 : half + 160, half - 96 : half + 160]
    share = 64**2 / size**2
    mean = as_float64(level)[0, 0, 0]
    assert psnr(pred, truth) == pytest.approx(-10 * math.log10(share * mean**2), rel=1e-12)
    ratio = 256**2 / size**2
    assert 1 - ssim(pred, truth) == pytest.approx((1 - ssim(near, small)) * ratio, rel=1e-9)
    assert flip(pred, truth) == pytest.approx(flip(near, small) * ratio, rel=1e-12)


@pytest.mark.parametrize("dtype", DTYPES)
def test_every_preset_answers_quietly_in_every_dtype(dtype):
    """uint8, grey, transposed views and read-only arrays included; one hole in the images costs only a reason."""
    pred, truth = as_type(texture(70, 66), dtype), as_type(texture(70, 66, 1), dtype)
    regions = {name: np.ones((70, 66), bool) for name in ("full", "box", "box+0.05", "box+0.3", "body", "visible")}
    regions["hidden"] = np.zeros((70, 66), bool)
    regions["never_seen"] = "nothing was never seen"
    turned = pred.transpose(0, 1) if dtype == "bfloat16" else pred.transpose(1, 0, 2)
    for name in registry.names("metric preset"):
        scores = evaluate(pred, truth, regions, name)
        for identity, score in scores.items():
            expected = "/hidden" not in identity and "never_seen" not in identity
            assert math.isfinite(score.value) == expected, (name, identity, score)
            assert bool(score.reason) == (not expected)
        back = turned.transpose(0, 1) if dtype == "bfloat16" else turned.copy().transpose(1, 0, 2)
        assert {i: s.value for i, s in evaluate(back, truth, regions, name).items() if not s.reason} == {
            i: s.value for i, s in scores.items() if not s.reason
        }
        if dtype != "uint8":
            pred_bad = pred.clone() if dtype == "bfloat16" else pred.copy()
            pred_bad[0, 0, 0] = math.nan
            assert all(s.reason for i, s in evaluate(pred_bad, truth, None, name).items() if "/full" in i)


@pytest.mark.parametrize("dtype", DTYPES)
def test_grey_is_three_channels_and_rgba_is_refused(dtype):
    x, y = (as_type(np.repeat(texture(24, 24, s)[..., :1], 3, axis=2), dtype) for s in (0, 1))
    for name in registry.names("metric preset"):
        three = evaluate(x, y, None, name)
        grey = evaluate(x[..., 0], y[..., 0], None, name)
        assert {i: (s.value, s.reason) for i, s in three.items() if not s.reason} == {
            i: (s.value, s.reason) for i, s in grey.items() if not s.reason
        }
    alpha = as_type(np.ones((24, 24, 4)), dtype)
    with pytest.raises(ValueError, match="composite RGBA"):
        evaluate(alpha, alpha)
