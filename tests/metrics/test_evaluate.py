"""One frame: every region, every metric, with identities and reasons."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest

from ihbench.errors import BadInput
from ihbench.metrics import Identity, Score, evaluate, psnr, ssim

rng = np.random.default_rng(0)
TRUTH = rng.random((30, 26, 3)).astype(np.float32)
PRED = np.clip(TRUTH + 0.1 * rng.standard_normal(TRUTH.shape), 0, 1).astype(np.float32)
BODY = np.zeros((30, 26), bool)
BODY[4:20, 5:19] = True


def numbers(scores):
    """Those of PSNR and SSIM."""
    return {name: score for name, score in scores.items() if name.startswith(("psnr", "ssim"))}


def to_8bit(image):
    return np.rint(image * 255).astype(np.uint8)


def test_scores_are_those_of_the_8bit_images():
    pred, truth = to_8bit(PRED), to_8bit(TRUTH)
    scores = evaluate(PRED, TRUTH, {"full": None, "body": BODY})
    assert {name: score.value for name, score in numbers(scores).items()} == {
        "psnr/pooled/range1/full/v1": psnr(pred, truth),
        "ssim/gauss11-1.5/range1/full/v1": ssim(pred, truth),
        "psnr/pooled/range1/body/v1": psnr(pred, truth, BODY),
        "ssim/gauss11-1.5/range1/body/v1": ssim(pred, truth, BODY),
    }
    assert all(name == score.identity for name, score in scores.items())
    for other in (
        evaluate(pred, truth, {"full": None, "body": BODY}),
        evaluate(PRED, truth, {"full": None, "body": BODY}),
    ):
        assert numbers(other) == numbers(scores)


def test_values_are_clipped_and_rounded_to_8_bits():
    close = evaluate(TRUTH + np.float32(0.3 / 255) * np.where(TRUTH < 0.5, 1, -1), to_8bit(TRUTH) / 255.0)
    unrounded = to_8bit(TRUTH) / 255.0 + np.where(TRUTH < 0.5, 0.4, -0.4) / 255
    assert evaluate(unrounded, to_8bit(TRUTH))["psnr/pooled/range1/full/v1"].value == math.inf
    assert close.keys() == evaluate(PRED, TRUTH).keys()
    white = np.ones((9, 9, 3))
    assert evaluate(white * 7.5, white, hdr=True)["psnr/pooled/range1/full/v1"].value == math.inf
    assert evaluate(white * -3, white * 0, hdr=True)["psnr/pooled/range1/full/v1"].value == math.inf


def test_a_mask_of_everything_is_the_whole_frame():
    everything = evaluate(PRED, TRUTH, {"box": np.ones((30, 26), bool)})
    whole = evaluate(PRED, TRUTH, {"box": None})
    assert numbers(everything) == numbers(whole)


def test_a_region_that_does_not_exist_is_absent_with_its_reason():
    scores = evaluate(PRED, TRUTH, {"hidden": "no truth for hidden pixels", "visible": np.zeros((30, 26), bool)})
    assert {name: score.reason for name, score in numbers(scores).items()} == {
        "psnr/pooled/range1/hidden/v1": "no truth for hidden pixels",
        "ssim/gauss11-1.5/range1/hidden/v1": "no truth for hidden pixels",
        "psnr/pooled/range1/visible/v1": "empty region in this view",
        "ssim/gauss11-1.5/range1/visible/v1": "empty region in this view",
    }
    assert all(score.absent for score in scores.values())


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("where", ["pred", "truth"])
def test_a_bad_pixel_makes_only_its_regions_absent(bad, where):
    pred, truth = PRED.copy(), TRUTH.copy()
    (pred if where == "pred" else truth)[25, 3, 1] = bad
    scores = evaluate(pred, truth, {"full": None, "body": BODY})
    clean = evaluate(PRED, TRUTH, {"body": BODY})
    for name in ("psnr/pooled/range1/full/v1", "ssim/gauss11-1.5/range1/full/v1"):
        assert scores[name].absent
        assert "NaN" in scores[name].reason
    for name, score in numbers(clean).items():
        assert scores[name].value == pytest.approx(score.value, abs=1e-10)
    mixed = evaluate(pred, to_8bit(TRUTH), {"body": BODY}) if where == "pred" else clean
    for name, score in numbers(clean).items():
        assert mixed[name].value == pytest.approx(score.value, abs=1e-10)


def test_a_background_other_than_white_is_another_identity_where_it_enters():
    black = evaluate(PRED, TRUTH, {"full": None, "body": BODY}, background=(0, 0, 0))
    assert list(numbers(black)) == [
        "psnr/pooled/range1/full/v1", "ssim/gauss11-1.5/range1/full/v1",
        "psnr/pooled/range1/body/v1", "ssim/gauss11-1.5/range1/body/bg0,0,0/v1",
    ]  # fmt: skip
    assert black["ssim/gauss11-1.5/range1/body/bg0,0,0/v1"].value == ssim(
        to_8bit(PRED), to_8bit(TRUTH), BODY, background=0.0
    )


def test_truth_as_prediction_is_perfect():
    perfect = {"psnr": math.inf, "ssim": 1.0, "flip": 0.0}
    for score in evaluate(TRUTH, TRUTH, {"full": None, "body": BODY}, slow=False).values():
        assert score.value == perfect[score.identity.partition("/")[0]]


def test_inputs_are_left_alone():
    pred, truth, mask = PRED.copy(), TRUTH.copy(), BODY.copy()
    evaluate(pred, truth, {"body": mask})
    assert (pred == PRED).all()
    assert (truth == TRUTH).all()
    assert (mask == BODY).all()


def test_an_unknown_preset_names_the_nearest():
    with pytest.raises(BadInput, match=r"'ihbenhc'.*ihbench"):
        evaluate(PRED, TRUTH, preset="ihbenhc")


@pytest.mark.parametrize("region", [np.ones((30, 25), bool), np.ones((30, 26), np.uint8)])
def test_a_region_that_does_not_fit_is_refused(region):
    with pytest.raises(ValueError, match=r"mask.*\(30, 26\)"):
        evaluate(PRED, TRUTH, {"body": region})


def test_images_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match=r"\(30, 25, 3\)"):
        evaluate(PRED[:, :-1], TRUTH)


def test_identities_are_joined_and_split_without_loss():
    for background in ("", "bg0,0,0"):
        identity = Identity("lpips", "vgg-0.1", "[-1,1]", "never_seen", 2, background)
        assert Identity.parse(str(identity)) == identity


@pytest.mark.parametrize("text", ["", "psnr", "psnr/pooled/range1/body/1", "psnr//range1/body/v1", "a/b/c/d/e/f/v1"])
def test_what_is_no_identity_is_refused(text):
    with pytest.raises(ValueError, match="metric identity"):
        Identity.parse(text)


def test_a_region_cannot_break_out_of_its_part():
    with pytest.raises(ValueError, match="metric identity"):
        evaluate(PRED, TRUTH, {"body/v2": None})


def test_an_absent_number_needs_a_reason():
    with pytest.raises(ValueError, match="reason"):
        Score(math.nan, "psnr/pooled/range1/body/v1")


def test_importing_and_psnr_load_neither_torch_nor_cv2():
    code = (
        "import sys, numpy as np; from ihbench.metrics import psnr; psnr(np.zeros((2, 2, 3)), np.ones((2, 2, 3)))\n"
        "assert not {'torch', 'cv2', 'scipy', 'skimage'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
