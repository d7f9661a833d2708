"""What is wrong with a table that somebody wrote: marks, arrows, units, decimals, claims within noise.

Rows are ranked over the whole column; if a table has sections and its marks fit them better, inside each. Rows that
only bound the others (the bench's calibration rows, "GT", "oracle") are not ranked. Of rows whose intervals overlap
the best one's by the root of the sum of squares, all may be marked or none must be. A comment "ihbench lint: paired"
before a table says that its marks come from paired differences, which intervals of single rows do not show: then
a mark may be missing or stand within noise, but not on a wrong number.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import median

from ihbench.document.marks import ranks
from ihbench.reports.lint.metric_names import BOUNDED, HeadMetric
from ihbench.reports.lint.table_reading import Head, Number, ReadCell, ReadTable

MARKED = {"best": "best mark", "second": "second-best mark"}
FACTORS = (1000.0, 100.0)  # between units of one metric
FAR = 10.0  # times the range of a column: no longer one of its numbers
OTHER_UNIT = 30.0  # ratio of two columns' medians


@dataclass(frozen=True, order=True)
class Finding:
    line: int
    cell: str  # "OccFusion, ZJU-MoCap SSIM ↑"
    what: str
    expected: str

    def __str__(self) -> str:
        return f"{self.line}: {self.cell}: {self.what}; expected {self.expected}"


@dataclass(frozen=True, eq=False)
class _Entry:
    """A ranked number in a column; equal to itself only."""

    label: str
    cell: ReadCell
    number: Number
    section: int

    @property
    def value(self) -> float:
        return self.number.value


@dataclass(frozen=True)
class _Column:
    head: Head
    metric: HeadMetric
    entries: tuple[_Entry, ...]

    def finding(self, entry: _Entry, what: str, expected: str) -> Finding:
        return Finding(entry.cell.line, f"{entry.label}, {self.head.title}", what, expected)

    def at_head(self, what: str, expected: str) -> Finding:
        return Finding(self.head.cell.line, f"column {self.head.title}", what, expected)


def lint(tables: Iterable[ReadTable]) -> list[Finding]:
    """Everything wrong with these tables, by line. Columns whose head names no metric are left alone."""
    return sorted(finding for table in tables for finding in set(_lint(table)))


def unknown_heads(table: ReadTable) -> list[Head]:
    """Heads of columns with marks that nobody can check: neither a known metric nor an arrow."""
    return [
        head
        for k, head in enumerate(table.heads)
        if head.metric is None and any(row.cells[k].mark for row in table.rows)
    ]


def _lint(table: ReadTable) -> Iterator[Finding]:
    checked = []
    for column in _columns(table):
        yield from _arrow(column)
        odd = dict(_units(column))
        yield from odd.values()
        # a number in another unit has neither the column's decimals nor a rank in it
        fitting = replace(column, entries=tuple(e for k, e in enumerate(column.entries) if k not in odd))
        yield from _decimals(fitting)
        checked.append(fitting)
    yield from _same_metric(checked)
    whole = list(_marks(checked, table.paired, apart=False))
    apart = list(_marks(checked, table.paired, apart=True)) if _has_sections(checked) else whole
    yield from min(whole, apart, key=len)  # the first of equals: the whole column


def _has_sections(columns: Sequence[_Column]) -> bool:
    """Whether rows may be meant to be ranked in sections: there are some of two rows or more, and every one has a
    best number marked somewhere."""
    entries = [entry for column in columns for entry in column.entries]
    rows: dict[int, set[int]] = {}
    for entry in entries:
        rows.setdefault(entry.section, set()).add(entry.cell.line)
    marked = {entry.section for entry in entries if entry.cell.mark == "best"}
    return len(rows) > 1 and all(len(lines) > 1 for lines in rows.values()) and marked == set(rows)


def _columns(table: ReadTable) -> list[_Column]:
    columns = []
    for k, head in enumerate(table.heads):
        entries = tuple(
            _Entry(row.label, row.cells[k], number, row.section)
            for row in table.rows
            if row.ranked and (number := row.cells[k].number) is not None
        )
        if head.metric is not None and entries:
            columns.append(_Column(head, head.metric, entries))
    return columns


# ---------------------------------------------------------------------------------------------- arrows and units


def _arrow(column: _Column) -> Iterator[Finding]:
    metric = column.metric
    if metric.usual is None:
        return
    right, better = ("↑", "higher") if metric.usual else ("↓", "lower")
    if not metric.arrow and not metric.cost:
        yield column.at_head("missing arrow", f"{right} beside {metric.name.upper()}: {better} is better")
    elif metric.arrow and metric.arrow != right:
        yield column.at_head(f"wrong arrow {metric.arrow}", f"{right}: of {metric.name.upper()} {better} is better")


def _units(column: _Column) -> Iterator[tuple[int, Finding]]:
    """Cells in another unit than most of the column: another suffix, or off by a factor of 100 or 1000. With the
    number of the entry."""
    units = Counter(entry.number.unit for entry in column.entries)
    most = max(units, key=lambda unit: (units[unit], unit))
    for k, entry in enumerate(column.entries):
        if entry.number.unit != most:
            shown, expected = (f"in {unit}" if unit else "without a unit" for unit in (entry.number.unit, most))
            what = f"mixed units: {entry.number.shown} {shown}"
            yield k, column.finding(entry, what, f"{expected}, as most of the column")
            continue
        factor = _off_by(column, entry) if column.metric.name in BOUNDED else 1.0
        if factor != 1:
            times = f"{factor:g} times it" if factor > 1 else f"1/{1 / factor:g} of it"
            what = f"mixed units: {entry.number.shown} does not fit the rest of the column"
            yield k, column.finding(entry, what, times)


def _off_by(column: _Column, entry: _Entry) -> float:
    """The factor that would bring a number far from all the others among them; 1 if there is none."""
    others = [abs(e.value) for e in column.entries if e is not entry and math.isfinite(e.value) and e.value]
    value = abs(entry.value)
    if len(others) < 2 or not value or not math.isfinite(value):
        return 1.0
    low, high = min(others), max(others)
    if low / FAR <= value <= high * FAR:
        return 1.0
    fitting = (f for f in (*FACTORS, *(1 / f for f in FACTORS)) if low / 2 <= value * f <= high * 2)
    return next(fitting, 1.0)


def _decimals(column: _Column) -> Iterator[Finding]:
    """One number of decimals in a column, or one number of significant digits."""
    entries = [entry for entry in column.entries if math.isfinite(entry.value)]
    decimals = Counter(entry.number.decimals for entry in entries)
    if column.metric.cost or len(decimals) <= 1 or len({entry.number.significant for entry in entries}) <= 1:
        return
    most = max(decimals, key=lambda d: (decimals[d], d))
    for entry in entries:
        if entry.number.decimals != most:
            what = f"inconsistent decimals: {entry.number.shown} has {entry.number.decimals}"
            yield column.finding(entry, what, f"{most}, as most of the column")


def _same_metric(columns: Sequence[_Column]) -> Iterator[Finding]:
    """One metric in several columns of a table must be one quantity."""
    for column in columns:
        first = next(c for c in columns if c.metric.name == column.metric.name)
        a, b = (median(abs(e.value) for e in c.entries) for c in (first, column))
        name, metric, other = column.metric.name.upper(), column.metric, first.metric
        if metric.name in BOUNDED and min(a, b) > 0 and max(a, b) / min(a, b) >= OTHER_UNIT:
            what, expected = f"around {b:g} here and around {a:g} in", "one unit in a table"
        elif metric.scaled != other.scaled:
            here, there = ("scaled" if m.scaled else "plain" for m in (metric, other))
            what, expected = f"is headed as {here} here and as {there} in", "one name for one unit"
        elif metric.unit and other.unit and metric.unit != other.unit:
            what, expected = f"in {metric.unit} here and in {other.unit} in", "one unit in a table"
        else:
            continue
        yield column.at_head(f"mixed units: {name} {what} {first.head.title}", expected)


# --------------------------------------------------------------------------------------------------------- marks


def _marks(columns: Sequence[_Column], paired: bool, apart: bool) -> Iterator[Finding]:
    used = {entry.cell.mark for column in columns for entry in column.entries}
    for column in columns:
        for section in sorted({entry.section for entry in column.entries}) if apart else [None]:
            entries = [entry for entry in column.entries if section in (None, entry.section)]
            yield from _marks_of(column, entries, used, paired)


def _marks_of(column: _Column, entries: Sequence[_Entry], used: set[str], paired: bool) -> Iterator[Finding]:
    """Marks of rows that are ranked together."""
    higher = column.metric.higher_is_better
    ranked = dict(zip(entries, ranks([entry.value for entry in entries], higher), strict=True))
    at = {rank: [e for e in entries if ranked[e] == rank] for rank in sorted({*ranked.values()})}
    if len(at) < 2:  # one number, or all equal: nothing is better than something else
        return
    best, next_best = list(at.values())[:2]
    if column.metric.cost:  # often shown beside the quality and not ranked
        used = {entry.cell.mark for entry in column.entries}
    yield from _one_mark(column, ranked, "best", best, "best" in used, paired)
    tied = [e for e in entries if e not in best and _within_noise(best[0].number, e.number, higher)]
    sharing = [e for e in tied if e.cell.mark == "best"] if all(e.cell.mark == "best" for e in best) else []
    if sharing:  # the next one that is not called best may be called second
        rest = [e for e in entries if e not in [*best, *sharing]]
        next_best = [e for e in rest if ranked[e] == min(ranked[e] for e in rest)]
        if not next_best:
            return
    # two best leave no second, and of two numbers the second is the last; who marks it all the same does no harm
    strict = len(best) == 1 and len(entries) > 2 and not tied
    yield from _one_mark(column, ranked, "second", next_best, strict and "second" in used, paired)


def _one_mark(
    column: _Column,
    ranked: Mapping[_Entry, int],
    mark: str,
    right: Sequence[_Entry],  # who deserves it by value
    required: bool,  # whether somebody must have it
    paired: bool,  # marks may be absent for reasons that the table does not show
) -> Iterator[Finding]:
    higher, name = column.metric.higher_is_better, MARKED[mark]
    noisy = [e for e in ranked if ranked[e] > ranked[right[0]] and _within_noise(right[0].number, e.number, higher)]
    marked = [entry for entry in ranked if entry.cell.mark == mark]
    with_mark, missing = ([e for e in right if (e in marked) is there] for there in (True, False))
    wrong = [e for e in marked if e not in right and not (e in noisy and with_mark)]
    names = " and ".join(f"{e.label} ({e.number.shown})" for e in right)
    for entry in wrong:
        what = f"wrong {name}: {entry.number.shown} is {_ordinal(ranked[entry])} of {len(ranked)}"
        yield column.finding(entry, what, f"the mark on {names}")
    for entry in missing:
        if with_mark:
            what = f"tie: {entry.number.shown} equals the marked {with_mark[0].label}"
            yield column.finding(entry, what, f"the {name} here too")
        elif required and not (wrong or paired or noisy):
            yield column.finding(
                entry, f"missing {name}", f"{entry.number.shown} marked as {name.removesuffix(' mark')}"
            )
    # the best row is the second-best one's better, and a best that is marked too claims nothing over it
    rival = next((entry for entry in noisy if entry not in marked), None)
    if rival and with_mark and not paired:
        what = f"claim within noise: {name}, but {rival.label} ({rival.number.shown}) is not further away"
        yield column.finding(with_mark[0], f"{what} than their intervals", "no mark, or one on both")


def _within_noise(better: Number, worse: Number, higher: bool) -> bool:
    """Whether two numbers differ by no more than the root of the sum of squares of the intervals' facing halves."""
    if not (better.has_interval and worse.has_interval):
        return False
    down, up = (better.value - better.low, worse.high - worse.value)
    if not higher:
        down, up = (better.high - better.value, worse.value - worse.low)
    return abs(better.value - worse.value) <= math.hypot(max(down, 0.0), max(up, 0.0))


def _ordinal(rank: int) -> str:
    return f"{rank}{'th' if 10 <= rank % 100 <= 20 else {1: 'st', 2: 'nd', 3: 'rd'}.get(rank % 10, 'th')}"
