"""Measures of inpainting: zero where nothing is wrong, and the analytic value where it is known."""

import json
import math
from dataclasses import asdict, replace

import numpy as np
import pytest
from skimage.color import deltaE_ciede2000, rgb2lab

from ihbench.body import texel_table
from ihbench.files import atomic
from ihbench.methods.inpainthuman.studies.drift import Drift, flicker, hidden_scores, identity_drift
from ihbench.methods.inpainthuman.studies.patch_texture import STATISTICS, patch_count, patch_texture
from ihbench.metrics import psnr, ssim
from ihbench.metrics.flip import flip
from tests.bench.fake_capture import the_body

from .hidden_person import STRIP, all_unknown, crop, nothing_unknown, pattern, plain, truth

BODY = the_body()
YAWS = (0.0, 0.15, 0.3, 0.45)


@pytest.fixture(scope="module")
def views():
    """Four views of a person who turns; the second and the fourth have the strip."""
    return [crop(k, pattern(), yaw, STRIP if k % 2 else None) for k, yaw in enumerate(YAWS)]


@pytest.fixture(scope="module")
def truths(views):
    return [truth(view, pattern(), yaw) for view, yaw in zip(views, YAWS, strict=True)]


def painted(views, colours):
    """The views with their unknown pixels in one grey each."""
    return [view.completed(np.full_like(view.image, c)) for view, c in zip(views, colours, strict=True)]


def strips(count, base=0.5, hidden=slice(0, 128)):
    """Views of the same pose in one grey, of which `hidden` columns are unknown."""
    return [crop(k, plain((base,) * 3), 0.0, hidden) for k in range(count)]


# -------------------------------------------------------------------------------------------- drift


def test_the_truth_does_not_drift_and_noise_does(views, truths):
    drift = identity_drift(views, [v.completed(t) for v, t in zip(views, truths, strict=True)], BODY)
    assert drift.texels > 300
    assert drift.patches >= 5
    assert drift.reason == ""
    assert drift.rgb < 0.02
    assert drift.delta_e < 3
    assert abs(drift.rgb - drift.rgb_floor) < 0.01
    noise = np.random.default_rng(0)
    noisy = [v.completed(noise.integers(0, 256, v.image.shape, dtype=np.uint8)) for v in views]
    worse = identity_drift(views, noisy, BODY)
    assert worse.rgb > 0.15
    assert worse.texture > 4 * drift.texture
    assert (worse.rgb_floor, worse.texels) == (drift.rgb_floor, drift.texels)


def test_a_shifted_colour_drifts_by_the_shift(views, truths):
    """Seen surface in one colour, painted in another: exactly the difference, in RGB and in CIEDE2000."""
    a, b = (0.4, 0.6, 0.2), (0.5, 0.56, 0.22)
    seen, wrong = (np.round(255 * np.array(c)) for c in (a, b))
    flat = [replace(v, image=np.where(v.person[..., None], seen, 255).astype(np.uint8)) for v in views]
    drift = identity_drift(
        flat, [v.completed(np.broadcast_to(wrong.astype(np.uint8), v.image.shape)) for v in flat], BODY
    )
    assert drift.rgb == pytest.approx(np.abs(seen - wrong).mean() / 255, abs=1e-6)
    difference = deltaE_ciede2000(rgb2lab(seen / 255), rgb2lab(wrong / 255))
    assert 1 < difference < 0.5 * np.linalg.norm(rgb2lab(seen / 255) - rgb2lab(wrong / 255)), "not CIE76"
    assert drift.delta_e == pytest.approx(difference, abs=1e-4)
    assert drift.texture == pytest.approx(0, abs=1e-4), "a plain colour has no pattern, whatever it is"
    assert drift.rgb_floor == pytest.approx(0, abs=1e-6)


def test_a_lost_pattern_shows_in_the_texture_even_in_the_right_colour(views, truths):
    """Stripes seen, their mean painted."""
    y = BODY.v_template[:, 1:2]
    striped = np.where(np.sin(70 * y) > 0, 0.8, 0.2) * np.ones(3)
    seen = [crop(k, striped, yaw, STRIP if k % 2 else None) for k, yaw in enumerate(YAWS)]
    right = [truth(v, striped, yaw) for v, yaw in zip(seen, YAWS, strict=True)]
    kept = identity_drift(seen, [v.completed(t) for v, t in zip(seen, right, strict=True)], BODY)
    lost = identity_drift(seen, painted(seen, (128,) * 4), BODY)
    assert lost.texture > 2.5 * kept.texture


@pytest.mark.parametrize("case", ["nothing painted", "nothing seen", "no view"])
def test_absent_drift_has_a_reason(case, views):
    given = {"nothing painted": [nothing_unknown(v) for v in views], "nothing seen": [all_unknown(v) for v in views]}
    chosen = given.get(case, [])
    drift = identity_drift(chosen, [v.image for v in chosen], BODY)
    assert drift.texels == drift.patches == 0
    assert math.isnan(drift.rgb)
    assert math.isnan(drift.delta_e)
    assert math.isnan(drift.texture)
    assert "no texel is painted in one view and seen in another" in drift.reason
    assert math.isnan(drift.rgb_floor) == (case != "nothing painted")
    assert json.dumps(atomic.encode(drift), allow_nan=False)
    assert Drift(**atomic.decode(atomic.encode(drift))).reason == drift.reason


def test_one_image_per_view(views):
    with pytest.raises(ValueError, match="zip"):
        identity_drift(views, [views[0].image], BODY)


# -------------------------------------------------------------------------------------------- patches


def test_patch_texture_of_known_patterns():
    """On the map itself: plain is 0; stripes of two lightnesses deviate by half their distance, along one axis."""
    texels = texel_table(BODY, 128)
    number = np.arange(len(texels.index))
    patch, plain_values = patch_texture(number, np.full((len(number), 3), 0.3), texels)
    assert len(patch) > 50
    assert (np.diff(patch) > 0).all()
    assert patch.max() < patch_count(128)
    assert plain_values.shape == (len(patch), STATISTICS)
    np.testing.assert_allclose(plain_values, 0, atol=1e-9)
    row = texels.index // 128
    grey = np.where((row // 2) % 2, 0.8, 0.2)[:, None] * np.ones(3)  # STEP is 2 texels: every step changes stripe
    patch, values = patch_texture(number, grey, texels)
    distance = rgb2lab(np.full(3, 0.8))[0] - rgb2lab(np.full(3, 0.2))[0]
    full = np.bincount(_patch_of(texels))[patch] == 64
    assert full.sum() > 10
    np.testing.assert_allclose(values[full, 0], distance / 2, rtol=1e-6)
    np.testing.assert_allclose(values[:, 3], 0, atol=1e-9)  # along the stripes
    np.testing.assert_allclose(values[full][:, [4, 5, 6]], distance, rtol=1e-6)


def test_a_patch_that_is_mostly_missing_is_not_compared():
    texels = texel_table(BODY, 128)
    chosen = np.flatnonzero(np.random.default_rng(0).random(len(texels.index)) < 0.3)
    patch, _ = patch_texture(chosen, np.full((len(chosen), 3), 0.3), texels)
    assert len(patch) < 10
    assert patch_texture(np.zeros(0, np.int32), np.zeros((0, 3)), texels)[0].size == 0


def _patch_of(texels):
    row, column = np.divmod(texels.index, 128)
    return row // 8 * 16 + column // 8


# -------------------------------------------------------------------------------------------- flicker


def test_constant_fills_do_not_flicker_at_all():
    views = strips(4)
    result = flicker(views, painted(views, (90,) * 4), BODY)
    assert result.texels > 1000
    assert result.deviation == 0
    assert result.change == 0
    assert result.seen_texels == 0
    assert math.isnan(result.deviation_floor)
    assert math.isnan(result.change_floor)
    assert result.reason == "no texel is seen in two views"


def test_alternating_fills_flicker_by_the_analytic_amount():
    views = strips(4)
    result = flicker(views, painted(views, (50, 152, 50, 152)), BODY)
    assert result.deviation == pytest.approx(51 / 255, abs=1e-7)  # ± 51 about the mean
    assert result.change == pytest.approx(102 / 255, abs=1e-7)


def test_views_are_followed_in_order_of_index():
    views = strips(4)
    images = painted(views, (50, 60, 150, 160))
    order = [2, 0, 3, 1]
    result = flicker([views[k] for k in order], [images[k] for k in order], BODY)
    assert result.change == pytest.approx((10 + 90 + 10) / 3 / 255, abs=1e-7)
    assert result.deviation == pytest.approx(np.std([50, 60, 150, 160]) / 255, abs=1e-7)


def test_the_floor_is_the_lighting_of_what_is_seen():
    """Half of the body is seen in two lights; the painted half holds still."""
    hidden = slice(64, 128)
    views = [crop(k, plain((grey,) * 3), 0.0, hidden) for k, grey in enumerate((0.4, 0.6))]
    result = flicker(views, painted(views, (90, 90)), BODY)
    assert result.reason == ""
    assert result.deviation == 0
    assert result.deviation_floor == pytest.approx((153 - 102) / 2 / 255, abs=1e-6)
    assert result.change_floor == pytest.approx((153 - 102) / 255, abs=1e-6)


def test_absent_flicker_has_a_reason():
    (view,) = strips(1)
    one = flicker([view], [view.image], BODY)
    assert one.texels == 0
    assert math.isnan(one.deviation)
    assert "no texel is painted in two views" in one.reason
    assert json.dumps(atomic.encode(one), allow_nan=False)


# -------------------------------------------------------------------------------------------- scores


def silhouettes(views, truths):
    return [(t < 255).any(-1) for t in truths]


def test_scores_are_the_benchs_metrics_over_hidden_pixels(views, truths):
    inside = silhouettes(views, truths)
    images = painted(views, (100, 100, 140, 140))
    result = hidden_scores(images, truths, views, inside)
    for region, masks in {
        "hidden": [v.unknown & s for v, s in zip(views, inside, strict=True)],
        "on_body": [v.unknown & s & v.body for v, s in zip(views, inside, strict=True)],
    }.items():
        scores = result[region]
        squares = np.concatenate(
            [(i[m].astype(float) - t[m]) ** 2 for i, t, m in zip(images, truths, masks, strict=True)]
        )
        assert scores["psnr"] == pytest.approx(10 * np.log10(255**2 / squares.mean()), abs=1e-9)
        assert not masks[0].any()
        for metric in (psnr, ssim, flip):
            both = [metric(images[k], truths[k], masks[k]) for k in (1, 3)]
            assert min(both) <= scores[metric.__name__] <= max(both)


def test_pixels_that_are_known_or_off_the_person_do_not_count(views, truths):
    inside = silhouettes(views, truths)
    images = painted(views, (100,) * 4)
    other = [
        np.where((v.unknown & s)[..., None], i, np.uint8(0)) for v, s, i in zip(views, inside, images, strict=True)
    ]
    assert atomic.encode(hidden_scores(other, truths, views, inside)) == atomic.encode(
        hidden_scores(images, truths, views, inside)
    )


def test_the_truth_scores_best_and_nothing_hidden_is_absent(views, truths):
    inside = silhouettes(views, truths)
    best = hidden_scores([v.completed(t) for v, t in zip(views, truths, strict=True)], truths, views, inside)
    assert best["hidden"] == {"psnr": math.inf, "ssim": 1.0, "flip": 0.0}
    clear = [nothing_unknown(view) for view in views]
    none = hidden_scores([v.image for v in clear], truths, clear, inside)
    assert all(math.isnan(score) for region in none.values() for score in region.values())
    assert json.dumps(atomic.encode(none), allow_nan=False)
    assert json.dumps(atomic.encode(asdict(identity_drift(views, truths, BODY))), allow_nan=False)
