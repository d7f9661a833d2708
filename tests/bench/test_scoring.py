"""Scoring a scene's test views: order, regions, and that every view is read once."""

import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from ihbench import scoring
from ihbench.errors import BadInput
from ihbench.protocol import REGIONS
from ihbench.scoring import Scorer
from ihbench.views import open_scene
from ihbench.visibility import texel_visibility

from .fake_capture import fake_protocol, the_body, turning_capture

BODY = the_body()


@pytest.fixture(scope="module")
def reads():
    return Counter()


@pytest.fixture(scope="module")
def scorer(reads):
    def count(camera, frame, pixels):
        reads[camera, frame] += 1
        return pixels

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scoring, "VISIBILITY_TEXELS", 64)
        yield Scorer.build(open_scene(replace(turning_capture(), edit_image=count), fake_protocol()), BODY)


def region_of(identity):
    return next(name for name in REGIONS if f"/{name}/" in identity)


def test_what_was_seen_is_decided_by_the_training_views(scorer):
    expected = texel_visibility(scorer.scene.train, BODY, scorer.texels)
    assert np.array_equal(scorer.visibility.seen, expected.seen)
    assert np.array_equal(scorer.visibility.faced, expected.faced)


def test_the_truth_scores_perfectly_and_a_grey_image_does_not(scorer):
    loaded = scorer.load(5)
    best = scorer.score(loaded, loaded.view.image).scores
    grey = scorer.score(loaded, np.full_like(loaded.view.image, 0.5)).scores
    assert set(best) == set(grey)
    assert {region_of(identity) for identity in best} == set(scorer.scene.protocol.regions)
    for identity, score in best.items():
        if not score.absent:
            assert score.value == (math.inf if identity.startswith("psnr") else 1)
            assert grey[identity].value < score.value


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


@pytest.mark.parametrize("chosen", [range(12), [7, 2, 2, 11], [3], [1, 0], []], ids=str)
def test_views_come_in_order(scorer, chosen):
    assert [loaded.index for loaded in scorer.load_all(chosen)] == list(chosen)
    for loaded in scorer.load_all(chosen):
        assert loaded.key == scorer.scene.test_keys[loaded.index]
        assert (loaded.view.camera_id, loaded.view.frame) == (loaded.key.camera_id, loaded.key.frame)


def test_several_rows_read_every_view_once(scorer, reads):
    fresh = open_scene(scorer.scene.capture, scorer.scene.protocol)
    reads.clear()
    seen = []
    rows = {"truth": lambda view: view.image, "white": lambda view: np.ones_like(view.image)}
    results = replace(scorer, scene=fresh).score_rows(
        rows, range(12), lambda loaded, images: seen.append((loaded.index, sorted(images)))
    )
    assert seen == [(k, ["truth", "white"]) for k in range(12)]
    assert {name: [score.key for score in scores] for name, scores in results.items()} == {
        name: list(scorer.scene.test_keys) for name in rows
    }
    assert dict(reads) == {(key.camera, key.frame): 1 for key in scorer.scene.test_keys}
    body = next(k for k in results["truth"][0].scores if k.startswith("psnr") and region_of(k) == "body")
    assert all(score.scores[body].value == math.inf for score in results["truth"])
    assert all(score.scores[body].value < 30 for score in results["white"])


def test_an_error_while_reading_ahead_reaches_the_caller(scorer):
    def broken(camera, frame, pixels):
        if frame == 6:
            raise BadInput("camera 1 frame 6: truncated file")
        return pixels

    scene = open_scene(replace(scorer.scene.capture, edit_image=broken), scorer.scene.protocol)
    read = []
    with pytest.raises(BadInput, match="truncated"):
        read.extend(loaded.index for loaded in replace(scorer, scene=scene).load_all(range(12)))
    assert read == [0, 1]
