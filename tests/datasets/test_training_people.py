"""Procedural people to train on: varied, described rightly, and none of the stand-ins."""

from __future__ import annotations

import numpy as np
import pytest

from ihbench import registry
from ihbench.body import load_body
from ihbench.datasets.standin import training_people
from ihbench.datasets.standin.subject import Subject


@pytest.fixture(scope="module")
def body():
    return load_body()


@pytest.fixture(scope="module")
def one(body):
    return training_people.draw_person(3, body, 4)


def test_a_person_is_a_pure_function_of_their_number(body, one):
    again = training_people.draw_person(3, body, 4)
    assert again.phrases == one.phrases
    for a, b in zip(one.snapshots, again.snapshots, strict=True):
        assert (a.image == b.image).all()
    assert (training_people.draw_person(4, body, 1).snapshots[0].image.shape != one.snapshots[0].image.shape) or (
        training_people.draw_person(4, body, 1).snapshots[0].image != one.snapshots[0].image
    ).any()


def test_snapshots_show_a_whole_person_on_white(one):
    for shot in one.snapshots:
        rows, cols = np.nonzero(shot.silhouette)
        assert 100 < np.ptp(rows) < 300
        assert rows.min() > 0
        assert cols.min() > 0
        assert (shot.image[0] == 255).all()
        assert shot.image[shot.silhouette].mean() < 220


def test_captions_use_known_words_only(body):
    known = set(training_people.vocabulary())
    rng = np.random.default_rng(5)
    for _ in range(200):
        style = training_people.draw_style(rng)
        words = " ".join(training_people.phrases(style)).split()
        assert set(words) <= known
        assert training_people.traits(style).shape == (training_people.N_TRAITS,)
        assert np.isfinite(training_people.traits(style)).all()


def test_outfits_vary():
    rng = np.random.default_rng(6)
    styles = [training_people.draw_style(rng) for _ in range(120)]
    assert {style.top for style in styles} == set(training_people.TOPS)
    assert {style.top_pattern for style in styles} == set(training_people.PATTERNS)
    tops = np.array([style.top_colours[0] for style in styles])
    assert (tops.std(0) > 0.15).all()


def test_captions_name_the_colour(body):
    style = training_people.draw_style(np.random.default_rng(1))
    from dataclasses import replace

    navy = replace(style, bottom="jeans", bottom_colours=(training_people.COLOURS["navy"], style.skin), leg=1.95)
    assert "long navy jeans" in training_people.phrases(navy)


def test_no_stand_in_is_among_them(body):
    """The split that the model card states: stand-ins come from streams of their own."""
    styles = [training_people.draw_style(np.random.default_rng([*training_people.STREAM, n])) for n in range(1600)]
    drawn = {style.seed for style in styles}
    cast = [Subject(seed, number, body) for seed in range(10) for number in range(1, 13)]
    assert not drawn & {subject.style.seed for subject in cast}
    assert not {style.top_colours for style in styles} & {subject.style.top_colours for subject in cast}


def test_is_registered():
    assert registry.load("people", "procedural").draw_person is training_people.draw_person


@pytest.mark.parametrize(("number", "count"), [(-1, 1), (0, 0)])
def test_refuses_nobody(body, number, count):
    with pytest.raises(ValueError, match="expected 0 or more"):
        training_people.draw_person(number, body, count)
