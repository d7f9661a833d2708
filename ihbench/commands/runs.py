"""`ihbench runs list|rm|export`: what a folder of runs holds, removing runs from it, and their numbers as a table."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from ihbench import registry
from ihbench.commands.options.parse import subcommand
from ihbench.commands.options.printing import Printing
from ihbench.commands.options.run_filters import RunFilters
from ihbench.config_fields import Values
from ihbench.document.document import Table
from ihbench.errors import BadInput

if TYPE_CHECKING:
    from ihbench.record.index import Entry
    from ihbench.record.results import RunResult

DAMAGED = "damaged"
FILTERS = ("protocol", "scene", "method", "profile", "seed", "status")
UNITS = ("B", "kB", "MB", "GB", "TB")


@dataclass(frozen=True, kw_only=True)
class _Seed(RunFilters):
    seed: int | None = None
    """Only runs with this seed."""


@dataclass(frozen=True, kw_only=True)
class Filters(_Seed, Printing):
    status: str | None = None
    """Only runs that are running, done, diverged, failed, interrupted, skipped, timeout or damaged."""


RunLine = dict[str, Any]  # what is said of one run


@dataclass(frozen=True, kw_only=True)
class List(Filters):
    """One line a run: status, what it is, its headline number, age, size on disk, folder."""


@dataclass(frozen=True, kw_only=True)
class Remove(Filters):
    """Remove runs, named or chosen by filters. Only what the bench wrote goes, and no run that is being written."""

    run: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Run folders, or their names under --runs."""
    yes: bool = False
    """Do not ask. Needed where nobody can be asked."""


@dataclass(frozen=True, kw_only=True)
class Export(_Seed):
    """Every number of the runs that are done, view by view: one tidy table, as `ihbench.frame` has it."""

    out: Path
    """File to write: .csv, or .parquet (needs pyarrow)."""


def main(argv: list[str]) -> int:
    about = "What a folder of runs holds; removing runs; their numbers as one table."
    chosen = subcommand({"list": List, "rm": Remove, "export": Export}, argv, "runs", about)
    if isinstance(chosen, Export):
        return _export(chosen)
    return _remove(chosen) if isinstance(chosen, Remove) else _list(chosen)


def _export(chosen: Export) -> int:
    from ihbench.commands.report import say_left_out
    from ihbench.files.atomic import is_stream
    from ihbench.record import outputs
    from ihbench.record.frame import check_suffix, frame_of, write_frame
    from ihbench.record.index import Index

    outputs.check_file(chosen.out)
    check_suffix(chosen.out)
    results, left_out = Index(chosen.runs).results(**_filters(chosen))
    say_left_out(left_out)
    table = frame_of(results)
    if table.empty:
        raise BadInput(f"no run under {chosen.runs} matches that is done; see ihbench runs list")
    write_frame(table, chosen.out)
    said = sys.stderr if is_stream(chosen.out) else sys.stdout  # which may be the file itself
    print(f"{len(table)} numbers of {table['digest'].nunique()} runs written to {chosen.out}", file=said)
    return 0


def _filters(chosen: _Seed) -> Values:
    return {name: value for name in FILTERS if (value := getattr(chosen, name, None)) is not None}


def _list(chosen: Filters) -> int:
    rows = _matching(chosen)
    columns = ("status", "protocol", "scene", "method", "profile", "seed", "headline", "age", "size", "folder")
    chosen.show({"runs": rows}, [Table(columns, tuple(_cells(row) for row in rows), left=len(columns))])
    return 0


def _remove(chosen: Remove) -> int:
    from ihbench.record.store import remove_run, writer_of

    if bool(chosen.run) == bool(_filters(chosen)):
        raise BadInput("runs rm: either name run folders, or choose some by filters such as --status failed")
    rows = list(_named(chosen)) if chosen.run else _matching(chosen)
    written = [row for row in rows if writer_of(Path(row["folder"])) is not None]
    if written and chosen.run:
        raise BadInput(f"{written[0]['folder']}: is being written; wait for it to end. Nothing was removed")
    for row in written:
        print(f"ihbench: not removed, is being written: {row['folder']}", file=sys.stderr)
    rows = [row for row in rows if row not in written]
    if not rows:
        raise BadInput(f"no run under {chosen.runs} matches that can be removed; see ihbench runs list")
    if not _agreed(chosen, rows):
        print("nothing was removed", file=sys.stderr)
        return 1
    removed, kept = [], {}
    for row in rows:
        left = remove_run(Path(row["folder"]))
        removed.append(row["folder"])
        if left is not None:
            kept[row["folder"]] = str(left)
            print(f"ihbench: kept, since the bench did not write it: {left}", file=sys.stderr)
    if chosen.json:
        print(json.dumps({"removed": removed, "kept": kept}))
    else:
        print(f"removed {_counted(rows)}")
    return 0


def _agreed(chosen: Remove, rows: list[RunLine]) -> bool:
    """Whether these may go. Raises `BadInput` where nobody can be asked and --yes was not given."""
    if chosen.yes:
        return True
    for row in rows:
        print("would remove:", "  ".join(_cells(row)), file=sys.stderr)
    if chosen.json or not (sys.stdin.isatty() and sys.stderr.isatty()):
        raise BadInput(f"runs rm: would remove {_counted(rows)}; nothing was, add --yes")
    print(f"remove {_counted(rows)}? [y/N] ", end="", file=sys.stderr, flush=True)
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def _matching(chosen: Filters) -> list[RunLine]:
    """The runs that the filters choose, oldest first. Damaged ones match no filter but their status."""
    from ihbench.record.index import UNREADABLE, Index
    from ihbench.record.store import STATUSES

    if chosen.status is not None and chosen.status not in (*STATUSES, DAMAGED):
        raise BadInput(f"--status {chosen.status}: {registry.nearest(chosen.status, [*STATUSES, DAMAGED])}")
    filters = _filters(chosen)
    if chosen.status == DAMAGED:
        filters["status"] = UNREADABLE
    index = Index(chosen.runs)
    entries = index.query(**filters)
    results = {result.folder.name: result for result in index.results(**filters)[0]} if entries else {}
    return [_row(chosen.runs / entry.name, entry, results.get(entry.name)) for entry in entries]


def _named(chosen: Remove) -> Iterator[RunLine]:
    """The runs that are named, each once. Raises `BadInput` for one that is none."""
    from ihbench.record.index import read_entry
    from ihbench.record.store import check_is_run

    seen = set()
    for named in chosen.run:
        folder = named if os.path.lexists(named) else chosen.runs / named
        check_is_run(folder)
        if folder.resolve() in seen:
            continue
        seen.add(folder.resolve())
        yield _row(folder, *read_entry(folder, ""))


def _row(folder: Path, entry: Entry, result: RunResult | None) -> RunLine:
    from ihbench.record.index import UNREADABLE

    identity, value = _headline(result)
    entry_fields = ("protocol", "scene", "method", "profile", "seed", "reason", "created")  # None of damaged ones
    return {
        "status": DAMAGED if entry.status == UNREADABLE else entry.status,
        **{name: getattr(entry, name) for name in entry_fields},
        "identity": identity,
        "value": value,
        "bytes": _size(folder),
        "folder": str(folder),
    }


def _headline(result: RunResult | None) -> tuple[str | None, float | None]:
    """Identity and mean of the headline region's first metric; PSNR where it is there."""
    if result is None or result.status != "done":
        return None, None
    for identity, mean in result.own.items():
        if identity.region == result.headline and not mean.absent:
            return str(identity), mean.value
    return None, None


def _size(folder: Path) -> int:
    """Bytes of the files below a folder; links are not followed."""
    total = 0
    for where, _, names in os.walk(folder):
        for name in names:
            try:
                total += os.lstat(os.path.join(where, name)).st_size
            except OSError:
                continue
    return total


def _cells(row: RunLine) -> tuple[str, ...]:
    from ihbench.errors import visible
    from ihbench.metrics import Identity

    identity = row["identity"]
    value = Identity.parse(identity).display.text(row["value"]) if identity else ""
    named = (row[name] for name in ("status", "protocol", "scene", "method", "profile", "seed"))
    texts = ("" if text is None else visible(str(text)) for text in named)
    return (*texts, value, _age(row["created"]), _bytes(row["bytes"]), visible(row["folder"]))


def _age(created: str | None) -> str:
    if created is None:
        return ""
    seconds = (datetime.now(UTC) - datetime.fromisoformat(created)).total_seconds()
    for unit, length in (("d", 86400), ("h", 3600), ("min", 60)):
        if seconds >= length:
            return f"{seconds / length:.0f} {unit}"
    return "now"


def _bytes(number: float) -> str:
    k = 0
    while number >= 1000 and k < len(UNITS) - 1:
        number, k = number / 1000, k + 1
    return f"{number:.0f} {UNITS[k]}"


def _counted(rows: list[RunLine]) -> str:
    return f"{len(rows)} run{'s' * (len(rows) != 1)}, {_bytes(sum(row['bytes'] for row in rows))}"
