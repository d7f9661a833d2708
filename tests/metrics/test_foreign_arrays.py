"""Arrays as users of other libraries hand them over: each gives the right number, or is refused with the word that
helps. The wrong ones gave numbers that looked right."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image

from ihbench.metrics import evaluate, psnr, ssim, ssim_map
from ihbench.metrics.flip import flip, flip_map
from ihbench.metrics.lpips import lpips, random_networks
from ihbench.metrics.psnr import mean_of_channels
from ihbench.metrics.ssim import Window
from ihbench.metrics.ssim_torch import ssim_map_torch

rng = np.random.default_rng(0)
A, B = rng.random((2, 24, 20, 3))
A8, B8 = (np.rint(image * 255).astype(np.uint8) for image in (A, B))
MASK = rng.random((24, 20)) < 0.5
METRICS = {
    "psnr": psnr,
    "channels": mean_of_channels, "ssim": ssim, "ssim_map": ssim_map, "flip": flip, "flip_map": flip_map,
    "lpips": lpips, "evaluate": evaluate,
}  # fmt: skip
MASKED = {name: METRICS[name] for name in ("psnr", "channels", "ssim", "flip", "lpips")}


@pytest.fixture(autouse=True, scope="module")
def networks():
    with random_networks():
        yield


def same(one, other):
    if isinstance(one, dict):
        one, other = ([score.value for score in scores.values()] for scores in (one, other))
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-12, equal_nan=True)


WRONG = {
    "values up to 255": (lambda x: x * 255, "divided by 255"),
    "values up to 65535": (lambda x: x * 65535, "divided by 65535"),
    "values from -1 to 1": (lambda x: 2 * x - 1, r"\(image \+ 1\) / 2"),
    "normalised": (lambda x: (x - 0.45) / 0.225, "normalisation"),
    "hdr": (lambda x: x * 1e6, "hdr=True"),
    "divided twice": (lambda x: x / 255, "divided by 255 twice"),
    "cast before it was multiplied": (lambda x: (x + 0.3).astype(np.uint8), "multiply by 255 before the cast"),
    "channels first": (lambda x: x.transpose(2, 0, 1), "move axis 0 to the end"),
    "a tensor, channels first": (lambda x: torch.tensor(x).permute(2, 0, 1), "move axis 0 to the end"),
    "a batch": (lambda x: x[None], "one image of the batch a call"),
    "a batch, channels first": (lambda x: x.transpose(2, 0, 1)[None], "channels last"),
    "RGBA": (lambda x: np.concatenate([x, x[..., :1]], 2), "composite RGBA"),
    "grey with alpha": (lambda x: x[..., :2], "composite RGBA"),
    "one row": (lambda x: x[0, :, 0], r"expected \[H, W\]"),
    "uint16": (lambda x: (x * 65535).astype(np.uint16), "uint16.*65535"),
    "int32 of 8 bits": (lambda x: (x * 255).astype(np.int32), r"int32.*astype\(np.uint8\)"),
    "bool": (lambda x: x > 0.5, "bool"),
    "longdouble": (lambda x: x.astype(np.longdouble), r"astype\(np.float64\)"),
    "complex": (lambda x: x.astype(np.complex128), "complex128"),
    "objects": (lambda x: x.astype(object), "object"),
    "a list": (lambda x: x.tolist(), "list.*np.asarray"),
    "a picture": (lambda x: Image.fromarray((x * 255).astype(np.uint8)), r"convert\('RGB'\)"),
    "a masked array": (lambda x: np.ma.masked_array(x, x > 0.9), "masked"),
    "nothing": (lambda x: None, "NoneType"),
}


@pytest.mark.parametrize("case", WRONG)
@pytest.mark.parametrize("metric", METRICS)
def test_another_range_or_layout_is_refused_with_the_word_that_helps(metric, case):
    change, word = WRONG[case]
    with pytest.raises(ValueError, match=word) as error:
        METRICS[metric](change(B), change(A))
    assert "\n" not in str(error.value)


RIGHT = {
    "float32": lambda x: x.astype(np.float32).astype(np.float64),
    "other byte order": lambda x: x.astype(">f8"),
    "a column order": np.asfortranarray,
    "mirrored twice": lambda x: x[::-1][::-1],
    "read-only": lambda x: np.broadcast_to(x, x.shape),
    "a subclass": lambda x: x.view(np.memmap),
    "a tensor with a gradient": lambda x: torch.tensor(x, requires_grad=True),
    "a permuted tensor": lambda x: torch.tensor(x.transpose(2, 0, 1)).permute(1, 2, 0),
    "a masked array's data": lambda x: np.ma.getdata(np.ma.masked_array(x)),
}


@pytest.mark.parametrize("case", RIGHT)
@pytest.mark.parametrize("metric", METRICS)
def test_the_same_image_in_another_container_gives_the_same_number(metric, case):
    change = RIGHT[case]
    plain = [np.asarray(change(x).detach() if isinstance(change(x), torch.Tensor) else change(x), np.float64)
             for x in (B, A)]  # fmt: skip
    same(METRICS[metric](change(B), change(A)), METRICS[metric](*plain))


@pytest.mark.parametrize("metric", METRICS)
def test_overshoot_is_taken_and_any_range_needs_the_switch(metric):
    overshoot = -0.02 + 1.05 * B  # a network without a last clamp
    METRICS[metric](overshoot, A)
    METRICS[metric](B, np.clip(A * (1 + 1e-6), 0, 1 + 1e-6))
    for pred, truth in ((1e3 * B, A), (2 * B - 1, 2 * A - 1), (B / 255, A / 255)):
        METRICS[metric](pred, truth, hdr=True)
    METRICS[metric](np.zeros_like(A), np.zeros_like(A))  # black is dark, and black
    METRICS[metric](B8 * 0 + 1, A8)  # dark against a bright truth is only wrong
    bad = B.copy()
    bad[0, 0] = np.nan
    bad[1, 1] = np.inf
    METRICS[metric](bad, A)


@pytest.mark.parametrize("metric", ["psnr", "channels", "ssim", "flip", "lpips"])
def test_one_uint8_and_one_float_are_refused_or_converted(metric):
    with pytest.raises(ValueError, match="divide the uint8 one by 255"):
        METRICS[metric](B8, A)
    same(evaluate(B8, A8 / 255), evaluate(B8, A8))
    with pytest.raises(ValueError, match=r"truth.*divided by 255"):
        evaluate(B8, A8.astype(np.float32))


@pytest.mark.parametrize(
    ("mask", "word"),
    [
        (MASK.astype(np.uint8) * 255, "mask != 0"),
        (MASK.astype(np.float32), "mask > 0.5"),
        (MASK[..., None], "one channel"),
        (MASK[None], "one channel"),
        (np.repeat(MASK[..., None], 3, 2), "any"),
        (MASK.T, "transpose"),
        (MASK[:12, :10], "of their size"),
        (MASK.tolist(), "list"),
        (Image.fromarray(MASK), "convert"),
        (MASK.astype(object), "object"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
@pytest.mark.parametrize("metric", [*MASKED, "evaluate"])
def test_other_masks_are_refused_with_the_word_that_helps(metric, mask, word):
    with pytest.raises(ValueError, match=word):
        METRICS[metric](B, A, {"body": mask} if metric == "evaluate" else mask)
    if metric == "lpips":
        with pytest.raises(ValueError, match=word):
            lpips(B, A, MASK, crop=mask)


@pytest.mark.parametrize("metric", MASKED)
def test_a_mask_as_a_tensor_and_garbage_outside_it_change_nothing(metric):
    value = MASKED[metric](B, A, MASK)
    assert MASKED[metric](B, A, torch.tensor(MASK)) == value
    outside = np.where(MASK[..., None], B, 1e4)
    assert MASKED[metric](outside, A, MASK) == pytest.approx(value, abs=1e-12)


@pytest.mark.parametrize("background", [255, (0, 0, 255), (-1, 0, 0), (1, 1), "white", None, np.nan, [None]])
@pytest.mark.parametrize("metric", ["ssim", "flip", "lpips", "evaluate"])
def test_a_background_outside_the_range_is_refused(metric, background):
    if metric == "ssim" and background is None:
        return  # there it means: do not paint
    mask = {"body": MASK} if metric == "evaluate" else MASK
    for images in ((B, A), (B8, A8)):
        with pytest.raises(ValueError, match="background"):
            METRICS[metric](*images, mask, background=background)


def test_a_data_range_that_the_images_do_not_have_is_refused():
    assert ssim(B * 255, A * 255, data_range=255) == pytest.approx(ssim(B, A), abs=1e-12)
    assert ssim(B8, A8) == pytest.approx(ssim(B8 / 255, A8 / 255), abs=1e-12)
    with pytest.raises(ValueError, match="uint8 images have peak 255 by themselves"):
        ssim(B8, A8, data_range=255)
    for function in (ssim, lambda *images, data_range: ssim_map(*images, window=Window(data_range=data_range))):
        with pytest.raises(ValueError, match="the data range is 1"):
            function(B, A, data_range=255)
        for wrong in (0, -1, np.nan, np.inf):
            with pytest.raises(ValueError, match="data range above 0"):
                function(B, A, data_range=wrong)
    for options in ({"border": "wrap"}, {"window": 11.0}, {"crop": 1.5}, {"window": True}):
        with pytest.raises(ValueError, match="ssim"):
            ssim(B, A, **options)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda x: x.permute(1, 2, 0), "channels before H and W"),
        (lambda x: (x * 255).to(torch.uint8), "divide uint8 by 255"),
        (lambda x: x * 255, "divided by 255"),
        (lambda x: 2 * x - 1, r"\(image \+ 1\) / 2"),
    ],
)
def test_the_training_loss_refuses_what_the_metric_does(change, word):
    x, y = (torch.tensor(image.transpose(2, 0, 1)) for image in (B, A))
    ssim_map_torch(-0.2 + 1.4 * x, y)  # a prediction in training may leave the range
    with pytest.raises(ValueError, match=word):
        ssim_map_torch(change(x), change(y))


def test_two_shapes_say_how_they_differ_and_an_empty_image_says_so():
    for pred, word in ((A[..., 0], "grey"), (A.transpose(1, 0, 2), "transpose"), (A[:5], "same shape")):
        with pytest.raises(ValueError, match=word):
            psnr(pred, B)
    with pytest.raises(ValueError, match="grey"):
        psnr(A[:20, :, 0], B[:20, :, :1])  # a square: nothing is exchanged
    assert {score.reason for name, score in evaluate(A[:0], B[:0]).items() if "lpips" not in name} == {
        "an image without a pixel"
    }
