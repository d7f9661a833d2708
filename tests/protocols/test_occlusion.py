from dataclasses import replace

import numpy as np
import pytest

from ihbench.errors import BadInput
from ihbench.protocols import occlusion
from ihbench.protocols.occlusion import fixed_strip, none, strip_generic
from ihbench.scene.occlusion import OcclusionRequest
from ihbench.scene.protocol import load_protocol


def request(subject="377", width=1024, silhouettes=None, covered=None, protocol="zju_occ", **changed):
    silhouettes = silhouettes if silhouettes is not None else [np.ones((4, width), bool)]
    return OcclusionRequest(
        subject=subject,
        rule=replace(load_protocol(protocol, "paper").occlusion, **changed),
        frames=list(range(len(silhouettes))),
        covered=covered or [True] * len(silhouettes),
        width=width,
        height=len(silhouettes[0]),
        silhouette=lambda k: silhouettes[k],
        body_mask=lambda k: silhouettes[k],
    )


@pytest.mark.parametrize(
    ("protocol", "subject", "first", "last"),
    [
        ("zju_occ", "377", 425, 494),
        ("zju_occ", "386", 375, 454),
        ("zju_occ", "387", 423, 472),
        ("zju_occ", "392", 378, 455),
        ("zju_occ", "393", 400, 467),
        ("zju_occ", "394", 386, 449),
        ("zju_occ_occnerf", "387", 418, 483),
        ("zju_occ_occnerf", "394", 391, 454),
    ],
)
def test_published_columns(protocol, subject, first, last):
    columns = np.flatnonzero(fixed_strip(request(subject, protocol=protocol)).hidden(0)[0])
    assert (columns[0], columns[-1], len(columns)) == (first, last, last - first + 1)


def test_a_strip_scales_with_the_image():
    assert np.flatnonzero(fixed_strip(request(width=512)).hidden(0)[0])[[0, -1]].tolist() == [213, 246]


def test_no_published_strip_is_said():
    with pytest.raises(BadInput, match="standin-1"):
        fixed_strip(request("standin-1"))


def test_generic_strip_is_the_narrowest_that_hides_half_and_is_centred_on_the_person():
    rng = np.random.default_rng(3)
    silhouettes = []
    for _ in range(6):
        mask = np.zeros((4, 100), bool)
        start = rng.integers(20, 50)
        mask[:, start : start + rng.integers(8, 30)] = True
        silhouettes.append(mask)
    covered = [True, True, False, True, True, True]
    strip = strip_generic(request(width=100, silhouettes=silhouettes, covered=covered))
    pooled = sum(s.sum(0) for s, c in zip(silhouettes, covered, strict=True) if c)
    share = pooled[strip.hidden(0)[0]].sum() / pooled.sum()
    mid, width = strip.record["mid"], strip.record["width"]
    narrower = pooled[mid - (width - 2) // 2 : mid + (width - 2) // 2].sum() / pooled.sum()
    assert narrower < 0.5 <= share
    assert mid == round((np.arange(100) * pooled).sum() / pooled.sum())
    assert width % 2 == 0


def test_generic_strip_without_anybody_is_an_error():
    with pytest.raises(BadInput, match="no person pixel"):
        strip_generic(request(silhouettes=[np.zeros((4, 1024), bool)]))


def test_none_hides_nothing():
    assert not none(request()).hidden(0).any()


def walkers(n=5, size=(160, 200)):
    """A figure of two ellipses that walks through the image."""
    rows, columns = np.mgrid[: size[0], : size[1]]
    return [
        (((rows - 90) / 60) ** 2 + ((columns - 50 - 22 * k) / 17) ** 2 < 1)
        | (((rows - 25) / 15) ** 2 + ((columns - 52 - 22 * k) / 12) ** 2 < 1)
        for k in range(n)
    ]


RULES = ["strip_generic", "central_band", "pasted_object", "side", "upper_half", "lower_half", "blocks"]


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("fraction", [0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 1.0])
def test_a_rule_hides_the_share_that_it_is_asked_for(rule, fraction):
    people = walkers(1) if rule == "strip_generic" else walkers()
    found = getattr(occlusion, rule)(request("anybody", 200, people, fraction=fraction))
    hidden = [(person & found.hidden(k)).sum() / person.sum() for k, person in enumerate(people)]
    assert all(h >= fraction - 1e-12 for h in hidden)
    # two columns of these small people are 7 % of them
    assert max(hidden) - fraction < (0.1 if rule in ("strip_generic", "central_band") else 0.06)
    if fraction == 0:
        assert max(hidden) == 0


@pytest.mark.parametrize("rule", ["pasted_object", "blocks"])
def test_what_is_drawn_depends_on_seed_subject_and_frame_only(rule):
    people = walkers()
    draw = lambda **k: getattr(occlusion, rule)(request("a", 200, people, fraction=0.4, **k)).hidden(3)  # noqa: E731
    assert (draw() == draw()).all()
    assert (draw() != draw(seed=1)).any()
    other = getattr(occlusion, rule)(request("b", 200, people, fraction=0.4)).hidden(3)
    assert (draw() != other).any()


def test_a_band_follows_the_person_and_halves_are_on_their_side():
    people = walkers()
    ask = request("a", 200, people, fraction=0.4)
    middle = [np.flatnonzero(occlusion.central_band(ask).hidden(k)[0]).mean() for k in range(5)]
    assert np.diff(middle) == pytest.approx([22] * 4, abs=1)
    assert occlusion.upper_half(ask).hidden(0)[0].all()
    assert not occlusion.upper_half(ask).hidden(0)[-1].any()
    assert occlusion.lower_half(ask).hidden(0)[-1].all()
    assert not occlusion.lower_half(ask).hidden(0)[0].any()
    assert occlusion.side(ask).hidden(0)[:, 0].all()
    assert not occlusion.side(ask).hidden(0)[:, -1].any()


@pytest.mark.parametrize("rule", ["central_band", "pasted_object", "side", "upper_half", "lower_half", "blocks"])
def test_a_frame_without_anybody_hides_nothing(rule):
    empty = [np.zeros((20, 30), bool)]
    assert not getattr(occlusion, rule)(request("a", 30, empty)).hidden(0).any()


def test_natural_is_the_body_that_the_mask_does_not_show():
    body = walkers(1)[0]
    shown = body.copy()
    shown[100:] = False
    ask = replace(request("a", 200, [shown]), body_mask=lambda frame: body)
    hidden = occlusion.natural(ask).hidden(0)
    assert not (hidden & shown).any()
    assert hidden[100:][body[100:]].all()
    margin = hidden & ~body
    assert 0 < margin.sum() < 0.3 * body.sum()
