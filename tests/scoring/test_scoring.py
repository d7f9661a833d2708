"""Scoring a scene's test views: order, regions, and that every view is read once."""

import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch

from ihbench.errors import BadInput
from ihbench.scene.protocol import REGIONS
from ihbench.scene.views import open_scene
from ihbench.scene.visibility import texel_visibility
from ihbench.scoring.scoring import Scorer
from tests.bench.fake_capture import fake_protocol, the_body, turning_capture

BODY = the_body()


@pytest.fixture(scope="module")
def reads():
    return Counter()


@pytest.fixture(scope="module")
def scorer(reads):
    def count(camera, frame, pixels):
        reads[camera, frame] += 1
        return pixels

    return Scorer.build(open_scene(replace(turning_capture(), edit_image=count), fake_protocol()))


def region_of(identity):
    return next(name for name in REGIONS if f"/{name}/" in identity)


def test_what_was_seen_is_decided_by_the_training_views(scorer):
    for seen in scorer.scene.training.sightings.values():
        expected = texel_visibility(scorer.scene.train, BODY, seen.texels)
        assert np.array_equal(seen.visibility.seen, expected.seen)
        assert np.array_equal(seen.visibility.faced, expected.faced)


def test_the_truth_scores_perfectly_and_a_grey_image_does_not(scorer):
    loaded = scorer.load(5)
    best = scorer.score(loaded, loaded.view.image).scores
    grey = scorer.score(loaded, np.full_like(loaded.view.image, 0.5)).scores
    assert set(best) == set(grey)
    assert {region_of(identity) for identity in best} == set(scorer.scene.protocol.metrics.regions)
    perfect = {"psnr": math.inf, "ssim": 1.0, "flip": 0.0}
    for identity, score in best.items():
        if not score.absent:
            metric = identity.partition("/")[0]
            assert score.value == perfect[metric]
            assert (grey[identity].value < score.value) == (metric != "flip")


def test_an_error_counts_in_its_own_regions_only(scorer):
    loaded = scorer.load(0)
    image = loaded.view.image.copy()
    image[loaded.regions["hidden"]] = 1 - image[loaded.regions["hidden"]]
    psnr = {region_of(k): s.value for k, s in scorer.score(loaded, image).scores.items() if k.startswith("psnr")}
    assert loaded.regions["hidden"].any()
    assert psnr["visible"] == psnr["never_seen"] == math.inf
    assert psnr["hidden"] < psnr["body"] < psnr["box"] < psnr["full"] < math.inf


def test_another_size_is_refused(scorer):
    loaded = scorer.load(0)
    with pytest.raises(BadInput, match=r"cam1/000000.*\(10, 48, 3\).*\(48, 48, 3\)"):
        scorer.score(loaded, np.zeros((10, 48, 3), np.float32))


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda x: x * 255, "divided by 255"),
        (lambda x: 2 * x - 1, r"\(image \+ 1\) / 2"),
        (lambda x: x.transpose(2, 0, 1), "move axis 0 to the end"),
        (lambda x: np.dstack([x, x[..., :1]]), "composite RGBA"),
        (lambda x: x[None], "batch"),
        (lambda x: x[..., 0], "expected"),
        (lambda x: (x * 255).astype(np.int64), "uint8"),
        (lambda x: x.tolist(), "list"),
    ],
)
def test_a_render_of_another_range_or_layout_is_refused_by_view(scorer, change, word):
    loaded = scorer.load(0)
    with pytest.raises(BadInput, match=f"cam1/000000.*{word}") as error:
        scorer.score(loaded, change(loaded.view.image))
    assert "hdr" not in str(error.value)
    with pytest.raises(BadInput, match=word):
        list(scorer.scored({"a": lambda loaded: change(loaded.view.image)}, [0]))


def test_a_render_may_be_a_tensor_or_overshoot_and_is_handed_on_as_an_array(scorer):
    loaded = scorer.load(0)
    image = loaded.view.image
    for render in (torch.tensor(image, requires_grad=True), image + np.where(image > 0.5, 0.6, -0.3)):
        (scored,) = scorer.scored({"a": lambda loaded, render=render: render}, [0])
        assert isinstance(scored.images["a"], np.ndarray)
        clipped = scorer.score(loaded, scored.images["a"].clip(0, 1)).scores
        assert {k: s.value for k, s in scored.scores["a"].scores.items() if not s.absent} == {
            k: s.value for k, s in clipped.items() if not s.absent
        }


def truth_of(loaded):
    return loaded.view.image


@pytest.mark.parametrize("threaded", [False, True])
@pytest.mark.parametrize("chosen", [range(12), [7, 2, 2, 11], [3], [1, 0], []], ids=str)
def test_views_come_in_order(scorer, chosen, threaded):
    found = list(scorer.scored({"truth": truth_of}, chosen, threaded=threaded, slow=False))
    assert [scored.loaded.index for scored in found] == list(chosen)
    for scored in found:
        loaded = scored.loaded
        assert loaded.key == scorer.scene.test_keys[loaded.index] == scored.scores["truth"].key
        assert (loaded.view.camera_id, loaded.view.frame) == (loaded.key.camera_id, loaded.key.frame)


@pytest.mark.parametrize("threaded", [False, True])
def test_several_rows_read_every_view_once(scorer, reads, threaded):
    fresh = open_scene(scorer.scene.capture, scorer.scene.protocol)
    reads.clear()
    seen = []
    rows = {"truth": truth_of, "white": lambda loaded: np.ones_like(loaded.view.image)}
    found = list(
        replace(scorer, scene=fresh).scored(
            rows, range(12), after_each=lambda loaded, images: seen.append((loaded.index, sorted(images))),
            threaded=threaded, slow=False,
        )
    )  # fmt: skip
    assert sorted(seen) == [(k, ["truth", "white"]) for k in range(12)]
    assert dict(reads) == {(key.camera, key.frame): 1 for key in scorer.scene.test_keys}
    body = next(k for k in found[0].scores["truth"].scores if k.startswith("psnr") and region_of(k) == "body")
    assert all(scored.scores["truth"].scores[body].value == math.inf for scored in found)
    assert all(scored.scores["white"].scores[body].value < 30 for scored in found)


def test_a_view_without_a_prediction_is_absent_in_everything(scorer):
    (found,) = scorer.scored({"none": lambda loaded: None}, [2])
    scores = found.scores["none"].scores
    assert set(scores) == set(scorer.score(found.loaded, found.loaded.view.image).scores)
    assert {score.reason for score in scores.values()} == {"no prediction of this view"}


def test_a_presets_own_regions_are_provided(scorer):
    legacy = Scorer.build(scorer.scene, ["occnerf", "gauhuman"])
    loaded = legacy.load(0)
    scores = legacy.score(loaded, loaded.view.image, slow=False).scores
    assert "psnr/occnerf-pooled/range1/box+0.3/v1" in scores
    assert all(score.value in (math.inf, 1.0) for score in scores.values() if not score.absent)
    assert loaded.regions["box+0.3"].sum() > loaded.regions["box+0.05"].sum()


@pytest.mark.parametrize("threaded", [False, True])
def test_an_error_while_reading_ahead_reaches_the_caller(scorer, threaded):
    def broken(camera, frame, pixels):
        if frame == 6:
            raise BadInput("camera 1 frame 6: truncated file")
        return pixels

    scene = open_scene(replace(scorer.scene.capture, edit_image=broken), scorer.scene.protocol)
    read = []
    with pytest.raises(BadInput, match="truncated"):
        read.extend(
            scored.loaded.index
            for scored in replace(scorer, scene=scene).scored({"truth": truth_of}, range(12), threaded=threaded)
        )
    assert read in ([0, 1], [0], [])
