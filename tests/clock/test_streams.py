"""What goes to the terminal: no unseen character of anybody's names, in whatever stream and encoding."""

from __future__ import annotations

import io
import sys
from types import SimpleNamespace

import pytest

from ihbench.cli import main
from ihbench.clock import streams
from ihbench.scene.method_spec import Command

NASTY = "a\x1b[2J\x1b[31mb\x9b\u202ec\U000e0041"


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def showing(monkeypatch, name):
    def command(argv):
        print(name)
        print(f"\t{name}", file=sys.stderr)
        with streams.styled():
            print("\x1b[1mbold\x1b[0m\x1b[2J")
        return 0

    spec = SimpleNamespace(commands={"nasty": Command(name, "theirs:main")}, load=lambda part: command)
    monkeypatch.setattr("ihbench.cli.usable_specs", lambda: [spec])


@pytest.mark.parametrize("stream", [io.StringIO, Terminal])
def test_a_commands_words_reach_every_stream_without_escapes(monkeypatch, stream):
    showing(monkeypatch, NASTY)
    monkeypatch.setattr(sys, "stdout", out := stream())
    monkeypatch.setattr(sys, "stderr", err := io.StringIO())
    assert main(["nasty"]) == 0
    shown = r"a\x1b[2J\x1b[31mb\x9b\u202ec\U000e0041"
    style = ("\x1b[1m", "\x1b[0m") if stream is Terminal else (r"\x1b[1m", r"\x1b[0m")
    assert out.getvalue() == f"{shown}\n{style[0]}bold{style[1]}\\x1b[2J\n"
    assert err.getvalue() == f"\t{shown}\n"
    print(NASTY)
    assert out.getvalue().endswith(f"{NASTY}\n")  # the stream is as it was before


@pytest.mark.parametrize(
    "words", [["nasty\x1b[2J"], ["--help"], ["report", "--runs", NASTY], ["run", f"--{NASTY}"], ["list", NASTY]]
)
def test_no_word_of_a_user_or_a_package_comes_back_raw(monkeypatch, capsys, words):
    showing(monkeypatch, NASTY)
    main(words)
    out, err = capsys.readouterr()
    assert not {"\x1b", "\x9b", "\u202e", "\U000e0041"} & {*out, *err}
