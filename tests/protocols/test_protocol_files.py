"""The shipped protocols against the released readers' numbers (facts with sources in the protocol files)."""

import pytest

from ihbench import registry
from ihbench.errors import BadInput
from ihbench.scene.protocol import difference, load_protocol, read_protocol

RAW = 10_000  # more frames than any subject has: the protocol's own limits rule


def test_zju_occ_trains_on_100_frames_of_which_80_are_covered():
    protocol = load_protocol("zju_occ", "paper")
    for subject in protocol.subjects.names:
        frames = protocol.training_frames(subject, RAW)
        assert frames == list(range(0, 500, 5))
        assert sum(protocol.covered(subject, frames, RAW)) == 80
        assert len(protocol.testing_cameras(23)) * len(protocol.testing_frames(subject, RAW)) == 374


@pytest.mark.parametrize(
    ("subject", "covered", "pairs"),
    [
        ("377", 456, 418),
        ("386", 432, 396),
        ("387", 432, 396),
        ("392", 444, 418),
        ("393", 526, 484),
        ("394", 380, 352),
    ],
)
def test_zju_occ_occnerf_counts(subject, covered, pairs):
    protocol = load_protocol("zju_occ_occnerf", "paper")
    frames = protocol.training_frames(subject, RAW)
    assert sum(protocol.covered(subject, frames, RAW)) == covered
    assert len(protocol.testing_cameras(23)) * len(protocol.testing_frames(subject, RAW)) == pairs


def test_the_two_readings_disagree_on_exactly_two_strips():
    changed = {
        key for key, _, _ in difference(load_protocol("zju_occ", "paper"), load_protocol("zju_occ_occnerf", "paper"))
    }
    assert {key for key in changed if key.startswith("occlusion.strips.")} == {
        "occlusion.strips.387",
        "occlusion.strips.394",
    }
    assert "occlusion.covers.of" in changed


@pytest.mark.parametrize("name", registry.names("protocol"))
@pytest.mark.parametrize("profile", ["quick", "paper"])
def test_every_shipped_protocol_reads_and_tests_on_no_view_that_it_trains_on(name, profile):
    protocol = load_protocol(name, profile)
    for subject in (*protocol.subjects.names, *protocol.subjects.standin, "anybody"):
        trained = {(protocol.train.camera, frame) for frame in protocol.training_frames(subject, 1000)}
        assert trained
        groups = {}
        for camera, frame, group in protocol.test_views(subject, 1000, 23):
            groups.setdefault(group, set()).add((camera, frame))
        shared = groups[""] & trained
        assert not shared, (subject, shared)
        assert all(name == "train = test" and views <= trained for name, views in groups.items() if name)
    assert protocol.id == name
    assert protocol.dataset in registry.names("dataset")
    assert {protocol.occlusion.rule, protocol.occlusion.unlisted} <= set(registry.names("occlusion"))


def test_the_digest_follows_choices_and_not_words():
    quick, paper = load_protocol("zju_occ", "quick"), load_protocol("zju_occ", "paper")
    assert quick.digest != paper.digest
    reworded = read_protocol_text(PROTOCOL.replace('title = "', 'title = "other '))
    assert reworded.digest == read_protocol_text(PROTOCOL).digest


PROTOCOL = (registry.package_folder("protocol", "zju_occ") / "zju_occ.toml").read_text(encoding="utf-8")


def read_protocol_text(text):
    import tempfile
    from pathlib import Path

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "p.toml"
        path.write_text(text, encoding="utf-8")
        read_protocol(path, "paper")
        return read_protocol(path, "quick")


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ("size = 512", "size = -3", "image.size"),
        ('edge = "hard"', 'edge = "fuzzy"', "image.edge"),
        ('headline = "body"', 'headline = "torso"', "headline"),
        ("[metrics]", "[metrix]", "metrics"),
        ("step = 5 }", "step = 0 }", "train.frames"),
        ("image = { size = 256,", "image = { sice = 256,", "sice"),
        ("[image]", "[image", "p.toml"),
        ('rule = "fixed-strip"', 'rule = "fixed-strap"', r"p\.toml: unknown occlusion 'fixed-strap': did you mean"),
    ],
)
def test_a_malformed_protocol_is_refused_in_one_line(old, new, word):
    assert old in PROTOCOL
    with pytest.raises(BadInput, match=word) as caught:
        read_protocol_text(PROTOCOL.replace(old, new, 1))
    assert "\n" not in str(caught.value)


def test_unknown_names_suggest_the_nearest():
    with pytest.raises(BadInput, match="did you mean 'zju_occ'"):
        load_protocol("zju_ocd")
    with pytest.raises(BadInput, match="did you mean 'quick'"):
        load_protocol("zju_occ", "quik")
