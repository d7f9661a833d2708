"""The shipped protocols against the released readers' numbers (facts with sources in the protocol files)."""

import pytest

from ihbench import registry
from ihbench.commands.options.parse import options
from ihbench.commands.protocol import Show
from ihbench.errors import BadInput
from ihbench.scene.protocol import Cameras, Span, TestGroup, difference, load_protocol, protocol_from, read_protocol

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


@pytest.mark.parametrize(
    ("words", "version"),
    [
        ("--image-size 128", "size=128"),
        ("--protocol.image.size 128", "size=128"),
        ("--protocol.image.size 512 --protocol.image.edge hard", ""),  # as it is
        ("--train-frames 0:300:5 --protocol.test.frames 1::2", "train=0:300:5+test=1::2"),
        ("--protocol.occlusion.fraction 0.3", "occlusion=strip-generic,fraction=0.3"),
        ("--occlusion.fraction 0.3 --protocol.occlusion.covers.of raw",
         "occlusion.covers.of=raw+occlusion=strip-generic,fraction=0.3"),
        ("--protocol.image.background 0 0 0.5 --protocol.image.undistort False",
         "image.background=0,0,0.5+image.undistort=false"),
        ("--protocol.subjects.spans 3 0:9:5,9:12:1", 'subjects.spans={"3":{"train":[0,9,5],"test":[9,12,1]}}'),
    ],
)  # fmt: skip
def test_every_choice_is_a_flag_and_stands_behind_the_version(words, version):
    chosen = options(Show, ["zju_occ", *words.split()], "protocol", "")
    own = load_protocol("zju_occ", "paper")
    (changed,) = chosen.apply(own)
    assert changed.changed == "+" * bool(version) + version
    assert (changed == own) is (version == "")
    assert protocol_from(changed.content, "paper", changed.name.partition("@")[2]) == changed


def test_further_test_views_are_a_flag():
    changed = load_protocol("zju_occ").with_fields({"also": ("twice,0:1,0:100:2",)})
    assert changed.also == (TestGroup("twice", Cameras(0, 1, 1), Span(0, 100, 2)),)
    assert len(changed.changed) < 30  # a digest stands for it


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("--image-size 64 --protocol.image.size 32", "--image-size says it, too"),
        ("--protocol.image.size 7", "--protocol.image.size 7: expected 8 to 8192"),
        ("--protocol.train.frames 5:1", "--protocol.train.frames: expected a stop above the start, found '5:1'"),
        ("--protocol.subjects.names ../x", "--protocol.subjects.names, entry 1: expected a name"),
        ("--protocol.image.background 0 0", "input length 2 did not match"),
        ("--protocol.metrics.regions full", "headline is 'body', expected one of full"),
        ("--protocol.metrics.regions body body", "'body' stands there twice"),
        ("--protocol.also a,0:3,0:9 a,0:3,9:12", "'a' stands there twice"),
    ],
)
def test_a_choice_that_no_protocol_has_is_refused_by_its_flag(words, told):
    with pytest.raises(BadInput) as refused:
        options(Show, ["zju_occ", *words.split()], "protocol", "").apply(load_protocol("zju_occ"))
    assert told in str(refused.value)
    assert "\n" not in str(refused.value)


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
