"""Runs as pages and reports tell of them to others: no text of a record names a place of the machine that made it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ihbench.record.results import Rows, RunResult
from ihbench.record.schema import About

CUT = "…"
_NAME = r"""[^\s/\\"'`<>|*?:;,()\[\]{}]"""  # what names of files are made of, outside quotes
_WORDS = rf"(?:[ ]{_NAME}+){{1,4}}"  # of a name with spaces, which only a further separator gives away
_RUN = re.compile(r"[^@]+@.+__s\d+__[0-9a-f]+")  # a run folder
_ABSOLUTE = re.compile(
    rf"""(?P<quote>["'`])(?:file://)?(?:/|\\\\|[A-Za-z]:[\\/])(?P<quoted>[^"'`\n]+)(?P=quote)
    | (?:file://|(?<![\w./\\<>~{CUT}-]))
      (?:/(?![/\s])|\\\\(?=\w)|(?<!\w)[A-Za-z]:[\\/](?=\w))
      (?P<bare>{_NAME}{{2,}}(?:(?:{_WORDS})?[/\\]{_NAME}+)*[/\\]?)""",
    re.VERBOSE,
)


def without_places(text: str, folder: Path | None = None) -> str:
    """The text with absolute paths (POSIX, Windows, file URLs) cut down to what they end with: "…/annots.npy". Paths
    in `folder`, a run's own, wherever it lay when the text was written, begin at that folder: "avatar/weights.pt".
    Of another run the folder's name is kept, which says which run it is."""

    def cut(found: re.Match[str]) -> str:
        quote = found["quote"] or ""
        parts = re.split(r"[/\\]+", (found["quoted"] or found["bare"]).rstrip("/\\"))
        if folder is not None and folder.name in parts:
            own = parts[parts.index(folder.name) + 1 :]
            return f"{quote}{'/'.join(own) or folder.name}{quote}"
        first = next((k for k, part in enumerate(parts) if _RUN.fullmatch(part)), len(parts) - 1)
        return f"{quote}{CUT}/{'/'.join(parts[first:])}{quote}"

    if folder is not None and len(folder.parts) > 1:  # its names may have anything in them
        text = text.replace(f"{folder}/", "").replace(str(folder), folder.name)
    return _ABSOLUTE.sub(cut, text)


def shareable(results: Sequence[RunResult]) -> list[RunResult]:
    """The same runs, with no places in reasons, warnings, notes, commands and changed switches. Switches that differ
    still do: rows are named by them."""
    switches = _told_apart(
        [value for run in results for value in (run.about.changed or {}).values() if isinstance(value, str)]
    )
    return [_run(run, switches) for run in results]


def _told_apart(values: Iterable[str]) -> dict[str, str]:
    """Value -> what is shown of it; two that end alike get numbers."""
    shown: dict[str, str] = {}
    for value in dict.fromkeys(values):
        short, taken = without_places(value), {*shown.values()}
        number = next(n for n in range(1, len(taken) + 2) if (short if n == 1 else f"{short} ({n})") not in taken)
        shown[value] = short if number == 1 else f"{short} ({number})"
    return shown


def _run(run: RunResult, switches: Mapping[str, str]) -> RunResult:
    def said(text: str) -> str:
        return without_places(text, run.folder)

    def rows(of: Rows) -> Rows:
        return {
            row: {i: replace(mean, reason=said(mean.reason)) if mean.reason else mean for i, mean in means.items()}
            for row, means in of.items()
        }

    record = run.record
    return replace(
        run,
        record=replace(
            record,
            outcome=replace(record.outcome, reason=said(record.outcome.reason)),
            about=_about(record.about, said, switches),
            warnings=tuple(map(said, record.warnings)),
        ),
        rows=rows(run.rows),
        presets={name: rows(of) for name, of in run.presets.items()},
        damage=tuple(map(said, run.damage)),
    )


def _about(about: About, said: Any, switches: Mapping[str, str]) -> About:
    files = about.predictions
    if files is not None:
        lists = {name: tuple(map(said, getattr(files, name))) for name in ("missing", "surplus", "notes", "doubts")}
        files = replace(files, folder=said(files.folder), **lists)
    left_out = about.left_out
    if left_out is not None:
        left_out = tuple(replace(one, reason=said(one.reason), value=_plain(one.value, said)) for one in left_out)
    return replace(
        about,
        command=tuple(map(said, about.command)),
        changed=None
        if about.changed is None
        else {name: switches[v] if isinstance(v, str) else v for name, v in about.changed.items()},
        left_out=left_out,
        predictions=files,
    )


def _plain(value: Any, said: Any) -> Any:
    return said(value) if isinstance(value, str) else value
