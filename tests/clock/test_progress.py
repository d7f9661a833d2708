"""Progress goes to stderr only, as a bar, as lines, or not at all."""

from __future__ import annotations

import io
import re

import pytest

from ihbench.clock.progress import Progress, duration


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def work(progress: Progress, clock: Clock | None = None, seconds: float = 0.0) -> None:
    with progress.task("fitting [quick]", total=4) as task:
        for step in range(4):
            if clock is not None:
                clock.now += seconds
            task.note(f"loss {step}")
            task.advance()


@pytest.mark.parametrize(
    ("stream", "ci", "mode"),
    [(Terminal(), "", "bar"), (Terminal(), "1", "plain"), (Terminal(), "false", "bar"), (io.StringIO(), "", "plain")],
)
def test_auto_looks_at_the_stream_and_at_ci(monkeypatch, stream, ci, mode):
    monkeypatch.setenv("CI", ci)
    assert Progress(stream=stream).mode == mode


def test_plain_lines_come_now_and_then_with_the_time_left():
    stream, clock = io.StringIO(), Clock()
    work(Progress("plain", stream, clock), clock, seconds=6.0)
    assert stream.getvalue().splitlines() == [
        "fitting [quick]: 2/4, 12.0 s left, loss 1",
        "fitting [quick]: 4/4, loss 3",
        "fitting [quick]: 4/4 in 24.0 s",
    ]


def test_short_work_says_nothing_in_plain_mode():
    stream, clock = io.StringIO(), Clock()
    work(Progress("plain", stream, clock), clock, seconds=0.1)
    assert stream.getvalue() == ""


def test_the_bar_shows_what_and_ends_clean():
    stream = Terminal()
    progress = Progress("bar", stream)
    with progress.task("outer [x]", total=2) as outer:
        work(progress)
        outer.advance()
        progress.say("a line [of its own]")
    shown = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", stream.getvalue())
    assert "outer [x]" in shown
    assert "a line [of its own]" in shown
    assert stream.getvalue().count("\x1b[?25h") >= stream.getvalue().count("\x1b[?25l")  # the cursor is shown again
    work(progress)  # and it can be used again


@pytest.mark.parametrize("mode", ["bar", "plain", "silent"])
def test_stdout_stays_clean_and_prints_go_through(mode, capsys):
    progress = Progress(mode, Terminal())
    with progress.task("outer"):
        print("result")
        progress.say("news")
        work(progress)
    assert capsys.readouterr().out == "result\n"


def test_silent_says_nothing():
    stream, clock = Terminal(), Clock()
    progress = Progress("silent", stream, clock)
    work(progress, clock, seconds=100.0)
    progress.say("news")
    assert stream.getvalue() == ""
    assert Progress.silent().mode == "silent"


@pytest.mark.parametrize("mode", ["bar", "plain"])
def test_an_error_passes_through_and_closes_the_task(mode):
    stream = Terminal()
    progress = Progress(mode, stream)

    def fails():
        with progress.task("fitting", total=4):
            raise RuntimeError("boom")

    with pytest.raises(RuntimeError, match="boom"):
        fails()
    work(progress)


def test_an_unknown_mode_is_refused():
    with pytest.raises(ValueError, match="fancy"):
        Progress("fancy")


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0, "0.0 s"),
        (59.94, "59.9 s"),
        (59.96, "1 min 00 s"),
        (245, "4 min 05 s"),
        (3599.6, "1 h 00 min"),
        (7620, "2 h 07 min"),
    ],
)
def test_durations_read_well_near_their_borders(seconds, text):
    assert duration(seconds) == text


@pytest.mark.parametrize("mode", ["bar", "plain"])
def test_names_bring_no_escape_sequences_to_the_terminal(mode):
    stream, clock = Terminal(), Clock()
    progress = Progress(mode, stream, clock)
    with progress.task("a\x1b]0;title\x07", total=1) as task:
        task.note("b\u202ec")
        progress.say("d\x1b[2Je\nf")
        clock.now += 20.0
        task.advance()
    shown = stream.getvalue()
    assert "d\\x1b[2Je\nf" in shown
    assert not [text for text in ("\x07", "\u202e", "\x1b]", "\x1b[2J") if text in shown]
