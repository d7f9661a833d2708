import numpy as np
import pytest

from ihbench.errors import BadInput
from ihbench.occlusion import OcclusionRequest
from ihbench.protocol import load_protocol
from ihbench.protocols.occlusion import fixed_strip, none, strip_generic


def request(subject="377", width=1024, silhouettes=None, covered=None, protocol="zju_occ"):
    silhouettes = silhouettes if silhouettes is not None else [np.ones((4, width), bool)]
    return OcclusionRequest(
        subject=subject,
        rule=load_protocol(protocol, "paper").occlusion,
        frames=list(range(len(silhouettes))),
        covered=covered or [True] * len(silhouettes),
        width=width,
        height=4,
        silhouette=lambda k: silhouettes[k],
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
    columns = np.flatnonzero(fixed_strip(request(subject, protocol=protocol)).columns)
    assert (columns[0], columns[-1], len(columns)) == (first, last, last - first + 1)


def test_a_strip_scales_with_the_image():
    assert np.flatnonzero(fixed_strip(request(width=512)).columns)[[0, -1]].tolist() == [213, 246]


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
    share = pooled[strip.columns].sum() / pooled.sum()
    mid, width = strip.record["mid"], strip.record["width"]
    narrower = pooled[mid - (width - 2) // 2 : mid + (width - 2) // 2].sum() / pooled.sum()
    assert narrower < 0.5 <= share
    assert mid == round((np.arange(100) * pooled).sum() / pooled.sum())
    assert width % 2 == 0


def test_generic_strip_without_anybody_is_an_error():
    with pytest.raises(BadInput, match="no person pixel"):
        strip_generic(request(silhouettes=[np.zeros((4, 1024), bool)]))


def test_none_hides_nothing():
    assert not none(request()).columns.any()
