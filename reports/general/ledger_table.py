"""What a run's seconds include: stages of the ledger, what no stage names, and whether it all adds up."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import chain

from ihbench.clock.ledger import REDONE, LedgerState, in_order
from ihbench.document.document import Block, Heading, Paragraph, Table, Words, bullets, emphasis, strong
from ihbench.record.results import RunResult
from ihbench.record.scene_means import seed_means
from ihbench.record.schema import RunRecord
from ihbench.reports.general.clock import by_machine

TOLERANCE = 0.02  # of the wall clock, that stages may leave unnamed
STAMPED = 2.0  # s; the record's time stamps are whole seconds at both ends
ROWS_AT_ONCE = 4  # columns of a table
INDENT = "· "
BEFORE = "open"  # booked by the run loop: it comes before the record is made
UNNAMED = "in no stage"
TOTAL = "wall clock"
SEVERAL_CLOCKS = ("shared", "resumed")  # events after which a ledger holds seconds that its process did not run


@dataclass(frozen=True)
class Account:
    """One run's books."""

    stages: dict[str, float]  # path -> s, parents before children
    wall: float  # s, the ledger's clock over all of the run's processes
    stamped: float  # s between the record's time stamps, and what it took to open the scene before them; NaN where
    # the run was interrupted, borrowed seconds, or was scored again

    @property
    def unnamed(self) -> float:
        """Seconds in no stage."""
        return self.wall - math.fsum(seconds for path, seconds in self.stages.items() if "/" not in path)

    @property
    def unnamed_share(self) -> float:
        return self.unnamed / self.wall if self.wall > 0 else 0.0

    @property
    def adds_up(self) -> bool:
        """Whether the named stages make up the wall clock within `TOLERANCE`, and no stage less than its parts."""
        return abs(self.unnamed_share) <= TOLERANCE and not self.overfull

    @property
    def overfull(self) -> list[str]:
        """Stages whose parts add up to more than the stage."""
        return [
            path
            for path, seconds in self.stages.items()
            if math.fsum(s for inner, s in self.stages.items() if inner.rpartition("/")[0] == path)
            > seconds + TOLERANCE * self.wall
        ]

    @property
    def agrees(self) -> bool:
        """Whether an independent clock says the same; True where there is none."""
        return math.isnan(self.stamped) or abs(self.wall - self.stamped) <= STAMPED + TOLERANCE * self.stamped


Books = Sequence[tuple[RunResult, Account]]  # of the runs of a row


def account(run: RunResult) -> Account | None:
    """The books of a run; None when it left none."""
    ledger = run.record.ledger
    if ledger is None:
        return None
    stages = {path: ledger.stages[path].seconds for path in in_order(ledger.stages)}
    return Account(stages, ledger.seconds, _stamped(run.record, ledger, scored_again=bool(run.presets)))


def ledger_section(runs: Sequence[RunResult]) -> list[Block]:
    """Mean seconds of every stage by row of the report, and the check; nothing where no run has a ledger."""
    rows = {label: [(run, a) for run in group if (a := account(run))] for label, group in by_machine(runs).items()}
    rows = {label: pairs for label, pairs in rows.items() if pairs}
    if not rows:
        return []
    blocks: list[Block] = [Heading(3, "What the seconds include")]
    labels = list(rows)
    for k in range(0, len(labels), ROWS_AT_ONCE):
        blocks.append(_table({label: rows[label] for label in labels[k : k + ROWS_AT_ONCE]}))
    return [*blocks, *_check([pair for pairs in rows.values() for pair in pairs])]


def _table(columns: dict[str, Books]) -> Table:
    paths = in_order(dict.fromkeys(path for books in columns.values() for _, a in books for path in a.stages))
    lines: list[tuple[Words, ...]] = []
    for path in paths:
        cells = [
            _cells(books, lambda a, path=path: a.stages.get(path, 0.0))
            if any(path in a.stages for _, a in books)
            else ["", ""]
            for books in columns.values()
        ]
        lines.append((INDENT * path.count("/") + path.rpartition("/")[2], *chain(*cells)))
    unnamed = chain(*(_cells(books, lambda a: a.unnamed) for books in columns.values()))
    total = chain(*(_cells(books, lambda a: a.wall) for books in columns.values()))
    lines += [(emphasis(UNNAMED), *unnamed), (strong(TOTAL), *total)]
    head: list[Words] = ["stage"]
    for label, books in columns.items():
        head += [f"{label}: s (mean of {len(books)})", "%"]
    return Table(tuple(head), tuple(lines))


def _cells(books: Books, seconds_of: Callable[[Account], float]) -> list[Words]:
    """Mean seconds, over the seeds of a scene, then over scenes, and their share of the wall clock."""
    seconds, wall = (_mean((run.scene, value(a)) for run, a in books) for value in (seconds_of, lambda a: a.wall))
    return [f"{seconds:.2f}", f"{100 * seconds / wall:.1f}" if wall > 0 else "—"]


def _mean(seconds: Iterable[tuple[str, float]]) -> float:
    means = seed_means(seconds)
    return math.fsum(means.values()) / len(means)


def _check(pairs: Books) -> list[Block]:
    shares = [a.unnamed_share for _, a in pairs]
    good = sum(a.adds_up for _, a in pairs)
    stamped = [a for _, a in pairs if not math.isnan(a.stamped)]
    note = (
        f"Named stages add up to the wall clock within {TOLERANCE:.0%} in {good} of {len(pairs)} runs; the rest, "
        f"{min(shares):.1%} to {max(shares):.1%}, is in its own row. Indented stages are parts of the one above."
    )
    if stamped:
        apart = max(abs(a.wall - a.stamped) for a in stamped)
        note += (
            f" The record's own time stamps (whole seconds) are at most {apart:.1f} s away from the ledger's wall "
            f"clock in the {len(stamped)} runs that went through in one go."
        )
    notes: list[Words] = []
    for run, a in pairs:
        who = f"{run.method} on {run.scene}, seed {run.seed}"
        if not a.adds_up:
            what = (
                f"{', '.join(a.overfull)} is less than its parts" if a.overfull else f"{a.unnamed_share:.1%} unnamed"
            )
            notes.append(f"does not add up: {who}: {what} of {a.wall:.0f} s")
        if not a.agrees:
            notes.append(f"clocks disagree: {who}: ledger {a.wall:.0f} s, time stamps {a.stamped:.0f} s")
    return [Paragraph(note), *bullets(notes)]


def _stamped(record: RunRecord, ledger: LedgerState, scored_again: bool) -> float:
    """Seconds from the record's creation to its last writing, where one process did the whole run in between."""
    again = scored_again or REDONE in ledger.stages or any(event.kind in SEVERAL_CLOCKS for event in ledger.events)
    again |= any(ledger.stages[path].entered > 1 for path in ("occlude", "load") if path in ledger.stages)
    if again or record.outcome.updated is None:
        return math.nan
    between = datetime.fromisoformat(record.outcome.updated) - datetime.fromisoformat(record.outcome.created)
    return between.total_seconds() + (ledger.stages[BEFORE].seconds if BEFORE in ledger.stages else 0.0)
