"""Numbers, names and paths from users: spelled in one way, within bounds, on the command line and from Python."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import pytest

from ihbench.commands.options.parse import options
from ihbench.config_fields import MultipleOf, Within, check, flat, with_fields
from ihbench.errors import BadInput
from ihbench.files.paths import user_path


@dataclass(frozen=True)
class Inner:
    rate: Annotated[float, Within(0, 1, above=True)] = 0.5


@dataclass(frozen=True)
class Some:
    count: Annotated[int, Within(1, 99), MultipleOf(3)] = 3
    shares: Annotated[tuple[float, ...], Within(0, 1)] = ()
    names: tuple[str, ...] = ()
    most: Annotated[int | None, Within(1, 9)] = None
    free: float = 0.0
    whole: int = 0
    name: str = "a"
    maybe: str = ""
    kind: Literal["a", "b"] = "a"
    file: Path | None = None
    inner: Inner = field(default_factory=Inner)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("--count 100", "--count 100: expected 1 to 99 and a multiple of 3"),
        ("--count 4", "--count 4: expected 1 to 99 and a multiple of 3"),
        *(
            (f"--whole {text}", "whole number in digits 0 to 9")
            for text in ("３", "²", "1_0", "+5", "0x1", "1e3", "1.0")
        ),
        (f"--whole {10**18}1", "expected"),
        (f"--whole {'9' * 5000}", "whole number in digits"),
        ("--whole 9223372036854775808", "--whole 9223372036854775808: expected a finite number, below 2^63"),
        *(
            (f"--free {text}", "a number in digits 0 to 9")
            for text in ("１", "1_0.5", "+1", "0x1p3", "infinity", "1,5")
        ),
        ("--free nan", "--free nan: expected a finite number"),
        ("--free -inf", "expected a finite number"),
        ("--free 1e999", "--free"),
        ("--shares 0.5 1.5", "--shares 0.5 1.5: expected 0 to 1"),
        ("--shares ٠", "expected numbers in digits 0 to 9"),
        ("--names \udcff", "expected plain text"),
        ("--most 0", "--most 0: expected 1 to 9"),
        ("--inner.rate 0", "--inner.rate 0.0: expected above 0, at most 1"),
        ("--name=", "--name '': expected a name"),
        ("--name \x1b[2J", "control characters"),
        (f"--name {'x' * 1001}", "1001 characters"),
        ("--kind c", "invalid choice"),
        ("--file=", "expected a path, found no text"),
        ("--file ~nouser/x", "no user 'nouser' here"),
        (f"--file {'x' * 300}", "a name of 300 bytes"),
        (f"--file {'x/' * 3000}", "a path of 6000"),
        ("--file a\0b", "zero byte"),
        ("--file loop", "links that lead in a circle"),
        ("--tyro-write-completion bash x", "would replace a file"),
        ("--tyro-print-completion nosh", "expected one of bash"),
    ],
)
def test_a_word_that_cannot_be_is_refused_by_its_option(words, told, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    Path("loop").symlink_to("loop")
    with pytest.raises(BadInput) as refused:
        options(Some, words.split(" "), "x", "")
    assert told in str(refused.value)
    assert words.split(" ")[0].split("=")[0] in str(refused.value)
    assert [path.name for path in tmp_path.iterdir()] == ["loop"]


def test_good_words_are_read(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    words = "--count 99 --shares 0 1 .5 2e-3 --most None --free -1.5e3 --whole -7 --name ä --file ~/x --inner.rate 1"
    read = options(Some, words.split(), "x", "")
    assert read == Some(99, (0, 1, 0.5, 0.002), (), None, -1500, -7, "ä", "", "a", tmp_path / "x", Inner(1))
    check(read)


@pytest.mark.parametrize(
    "change",
    [
        {"count": "3"}, {"count": True}, {"count": 3.0}, {"shares": [0.5]}, {"shares": ("a",)}, {"free": None},
        {"free": 10**400}, {"kind": "c"}, {"name": None}, {"file": "x"}, {"most": 10}, {"count": float("nan")},
        {"inner": None},
    ],
    ids=str,
)  # fmt: skip
def test_values_from_python_are_held_against_the_same_types_and_bounds(change):
    (name,) = change
    with pytest.raises(BadInput, match=f"--{name} .*: expected "):
        check(Some(**change))


def test_a_home_that_is_not_there_is_said(monkeypatch):
    monkeypatch.delenv("HOME", raising=False)
    monkeypatch.setattr("os.path.expanduser", lambda path: path)
    with pytest.raises(BadInput, match=r"cache ~/\.cache: this user has no home folder; set HOME"):
        user_path("~/.cache", "cache")


@dataclass(frozen=True)
class Part:
    a: int = 1
    b: str = "x"


@dataclass(frozen=True)
class Whole:
    c: float = 2.0
    inner: Part = field(default_factory=Part)


def test_nested_fields_come_dotted_and_go_back():
    assert flat(Whole()) == {"c": 2.0, "inner.a": 1, "inner.b": "x"}
    changed = with_fields(Whole(), {"inner.b": "y", "c": 3.0})
    assert changed == Whole(3.0, Part(1, "y"))
    assert with_fields(Whole(), flat(changed)) == changed
    assert with_fields(Whole(), {}) == Whole()


@pytest.mark.parametrize("name", ["other", "c.a", "inner.other"])
def test_unknown_fields_are_refused(name):
    with pytest.raises(TypeError):
        with_fields(Whole(), {name: 1})
