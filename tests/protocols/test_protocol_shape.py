"""Every value of a protocol file has a type and bounds, and what is wrong is named by its key."""

import math
import tomllib
from copy import deepcopy

import pytest

from ihbench import registry
from ihbench.config_fields import read
from ihbench.errors import BadInput
from ihbench.scene.protocol import PROFILES, ProtocolFile, load_protocol, read_protocol


@pytest.fixture
def protocol():
    path = registry.package_folder("protocol", "zju_occ") / "novel_pose.toml"
    return {k: v for k, v in tomllib.loads(path.read_text()).items() if k != "profile"}


def leaves(value, path=()):
    yield path
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in items:
        yield from leaves(item, (*path, key))


def replaced(content, path, value):
    content = deepcopy(content)
    if not path:
        return value
    table = content
    for key in path[:-1]:
        table = table[key]
    table[path[-1]] = value
    return content


JUNK = [
    *({}, [], [[]], {"a": {}}, "", "x" * 9999, "../..", "a/b", "\x1b[2J", True),
    *(-1, 10**30, math.nan, math.inf, -0.5),
]
# what may be free text, a free list, a truth value, or a number that a share may be
FINE = {
    "title",
    "reason",
    "source",
    "names",
    "standin",
    "max_frames",
    "spans",
    "also",
    "strips",
    "undistort",
    "except_train",
}


def test_every_registered_protocol_has_this_shape():
    for name in registry.names("protocol"):
        for profile in PROFILES:
            read(ProtocolFile, load_protocol(name, profile).content, name)


def refusal(content):
    try:
        read(ProtocolFile, content, "p.toml")
    except BadInput as error:
        return str(error)
    return ""


def test_every_value_of_another_kind_is_refused_by_its_key(protocol):
    refused = 0
    for path in leaves(protocol):
        for junk in JUNK:
            told = refusal(replaced(protocol, path, junk))
            if told:
                refused += 1
                assert told.startswith("p.toml: ")
                assert not path or str(path[0]) in told
                assert len(told) < 400
            else:
                assert FINE & set(path), (path, junk)
    assert refused > 700


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('version = "1"', "version = {}", "version: expected a name of 1 to 80 characters"),
        ("background = [1.0, 1.0, 1.0]", "background = []", "image.background: expected a list of 3 entries"),
        ("background = [1.0, 1.0, 1.0]", "background = [255, 255, 255]", "entry 1: expected a number, 0 to 1"),
        ('names = ["377"', 'names = "377" # ', "subjects.names: expected a list of 0 to 10000 entries, found '377'"),
        ("camera = 0", "camera = true", "train.camera: expected a whole number, 0 to 10000, found True"),
        ("camera = 0", "camera = 0.5", "train.camera: expected a whole number"),
        ("camera = 0", "kamera = 0", "unknown key 'train.kamera': did you mean 'camera'?"),
        ("size = 512", "size = inf", "image.size: expected a whole number, 8 to 8192, found inf"),
        ("size = 512", f"size = {'9' * 5000}", "not valid TOML"),
        ("stop = 500", "stop = 10000000000000", "train.frames.stop: expected a whole number, 0 to 10000000"),
        ("stop = 500", "stop = 1979-05-27", "train.frames.stop: expected"),
        ("[profile.paper]", "[[profile]]", "profile: expected the tables paper, quick"),
        ("image = { size = 256", "image = 3 # ", "image: expected a table, found 3"),
        ("377 = [460, 70]", "377 = [460]", "occlusion.strips.377: expected a list of 2 entries"),
        ("377 = [460, 70]", '"../x" = [460, 70]', "occlusion.strips, the name of an entry: expected a name"),
        ('id = "zju_occ"', f"id = {'[' * 5000}", "not valid TOML"),
        ('id = "zju_occ"', 'id = "\\u001b[2J"', r"id: expected a name"),
    ],
)
def test_a_damaged_file_is_refused_in_one_line(tmp_path, old, new, words):
    text = (registry.package_folder("protocol", "zju_occ") / "zju_occ.toml").read_text()
    assert old in text
    (tmp_path / "p.toml").write_text(text.replace(old, new, 1))
    with pytest.raises(BadInput) as refused:
        read_protocol(tmp_path / "p.toml", "quick" if "profile" in new or "256" in old else "paper")
    assert words in str(refused.value)
    assert "p.toml: " in str(refused.value)


def test_what_is_no_file_is_not_read(tmp_path):
    (tmp_path / "zero.toml").symlink_to("/dev/zero")
    (tmp_path / "folder.toml").mkdir()
    (tmp_path / "latin.toml").write_bytes(b'id = "\xff"')
    for name, words in (
        ("zero", "a device"),
        ("folder", "a folder"),
        ("latin", "not UTF-8"),
        ("a\0b", "zero byte|null"),
    ):
        with pytest.raises(BadInput, match=words):
            read_protocol(tmp_path / f"{name}.toml")
