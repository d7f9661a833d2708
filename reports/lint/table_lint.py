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
from ihbench.record.results import grouped
from ihbench.reports.lint.metric_names import BOUNDED, NO_METRIC
from ihbench.reports.lint.table_reading import Cell, Column, Table

MARKED = {"best": "best mark", "second": "second-best mark"}
FACTORS = (1000.0, 100.0, 1 / 1000, 1 / 100)  # between units of one metric
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


def lint(tables: Iterable[Table]) -> list[Finding]:
    """Everything wrong with these tables, by line. Columns whose head names no metric are left alone."""
    return sorted(finding for table in tables for finding in set(_lint(table)))


def _found(column: Column, cell: Cell | None, what: str, expected: str) -> Finding:
    """In a cell of a column, or at its head."""
    where = f"{cell.label}, {column.title}" if cell else f"column {column.title}"
    return Finding((cell or column).line, where, what, expected)


def _lint(table: Table) -> Iterator[Finding]:
    checked = []
    for whole in table.columns:
        column = replace(whole, cells=[cell for cell in whole.cells if cell.shown and cell.ranked])
        if column.metric == NO_METRIC or not column.cells:
            continue
        yield from _arrow(column)
        odd = dict(_units(column))
        yield from odd.values()
        # a number in another unit has neither the column's decimals nor a rank in it
        fitting = replace(column, cells=[cell for cell in column.cells if cell not in odd])
        yield from _decimals(fitting)
        checked.append(fitting)
    yield from _same_metric(checked)
    sections = grouped((cell.section, cell) for column in checked for cell in column.cells)
    # rows may be meant to be ranked in sections of two rows or more if every one has a best number marked somewhere
    apart = len(sections) > 1 and all(
        len({cell.line for cell in cells}) > 1 and any(cell.mark == "best" for cell in cells)
        for cells in sections.values()
    )
    ways = [list(_marks(checked, table.paired, apart=way)) for way in ([False, True] if apart else [False])]
    yield from min(ways, key=len)  # the first of equals: the whole column


# ---------------------------------------------------------------------------------------------- arrows and units


def _arrow(column: Column) -> Iterator[Finding]:
    metric = column.metric
    if metric.usual is None:
        return
    right, better = ("↑", "higher") if metric.usual else ("↓", "lower")
    if not metric.arrow and not metric.cost:
        yield _found(column, None, "missing arrow", f"{right} beside {metric.name.upper()}: {better} is better")
    elif metric.arrow and metric.arrow != right:
        expected = f"{right}: of {metric.name.upper()} {better} is better"
        yield _found(column, None, f"wrong arrow {metric.arrow}", expected)


def _units(column: Column) -> Iterator[tuple[Cell, Finding]]:
    """Cells in another unit than most of the column: another suffix, or off by a factor of 100 or 1000."""
    units = Counter(cell.unit for cell in column.cells)
    most = max(units, key=lambda unit: (units[unit], unit))
    for cell in column.cells:
        what = f"mixed units: {cell.shown} "
        if cell.unit != most:
            shown, expected = (f"in {unit}" if unit else "without a unit" for unit in (cell.unit, most))
            yield cell, _found(column, cell, what + shown, f"{expected}, as most of the column")
        elif column.metric.name in BOUNDED and (factor := _off_by(column, cell)):
            times = f"{factor:g} times it" if factor > 1 else f"1/{1 / factor:g} of it"
            yield cell, _found(column, cell, f"{what}does not fit the rest of the column", times)


def _off_by(column: Column, cell: Cell) -> float | None:
    """The factor that would bring a number far from all the others among them, if there is one."""
    others = [abs(c.value) for c in column.cells if c is not cell and math.isfinite(c.value) and c.value]
    value = abs(cell.value)
    if len(others) < 2 or not value or not math.isfinite(value):
        return None
    low, high = min(others), max(others)
    if low / FAR <= value <= high * FAR:
        return None
    return next((factor for factor in FACTORS if low / 2 <= value * factor <= high * 2), None)


def _decimals(column: Column) -> Iterator[Finding]:
    """One number of decimals in a column, or one number of significant digits."""
    cells = [cell for cell in column.cells if math.isfinite(cell.value)]
    decimals = Counter(cell.decimals for cell in cells)
    if column.metric.cost or len({cell.significant for cell in cells}) <= 1:
        return
    most = max(decimals, key=lambda d: (decimals[d], d))
    for cell in cells:
        if cell.decimals != most:
            what = f"inconsistent decimals: {cell.shown} has {cell.decimals}"
            yield _found(column, cell, what, f"{most}, as most of the column")


def _same_metric(columns: Sequence[Column]) -> Iterator[Finding]:
    """One metric in several columns of a table must be one quantity."""
    for column in columns:
        first = next(c for c in columns if c.metric.name == column.metric.name)
        a, b = (median(abs(cell.value) for cell in c.cells) for c in (first, column))
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
        yield _found(column, None, f"mixed units: {name} {what} {first.title}", expected)


# --------------------------------------------------------------------------------------------------------- marks


def _marks(columns: Sequence[Column], paired: bool, apart: bool) -> Iterator[Finding]:
    used = {cell.mark for column in columns for cell in column.cells}
    for column in columns:
        # costs are often shown beside the quality and not ranked
        wanted = {cell.mark for cell in column.cells} if column.metric.cost else used
        for cells in grouped((cell.section if apart else 0, cell) for cell in column.cells).values():
            yield from _marks_of(column, cells, wanted, paired)


def _marks_of(column: Column, cells: Sequence[Cell], used: set[str], paired: bool) -> Iterator[Finding]:
    """Marks of rows that are ranked together."""
    higher = column.metric.higher_is_better
    ranked = dict(zip(cells, ranks([cell.value for cell in cells], higher), strict=True))
    at = grouped((ranked[cell], cell) for cell in sorted(cells, key=ranked.__getitem__))
    if len(at) < 2:  # one number, or all equal: nothing is better than something else
        return
    best, next_best = list(at.values())[:2]
    yield from _one_mark(column, ranked, "best", best, "best" in used, paired)
    tied = [cell for cell in cells if cell not in best and _within_noise(best[0], cell, higher)]
    if all(cell.mark == "best" for cell in best):
        # the next one that is not called best may be called second
        shared = [cell for cell in tied if cell.mark == "best"]
        rest = [[cell for cell in alike if cell not in shared] for alike in list(at.values())[1:]]
        next_best = next(filter(None, rest), [])
    # two best leave no second, and of two numbers the second is the last; who marks it all the same does no harm
    strict = len(best) == 1 and len(cells) > 2 and not tied
    if next_best:
        yield from _one_mark(column, ranked, "second", next_best, strict and "second" in used, paired)


def _one_mark(
    column: Column,
    ranked: Mapping[Cell, int],
    mark: str,
    right: Sequence[Cell],  # who deserves it by value
    required: bool,  # whether somebody must have it
    paired: bool,  # marks may be absent for reasons that the table does not show
) -> Iterator[Finding]:
    higher, name = column.metric.higher_is_better, MARKED[mark]
    noisy = [c for c in ranked if ranked[c] > ranked[right[0]] and _within_noise(right[0], c, higher)]
    marked = [cell for cell in ranked if cell.mark == mark]
    with_mark, missing = ([c for c in right if (c in marked) is there] for there in (True, False))
    wrong = [c for c in marked if c not in right and not (c in noisy and with_mark)]
    names = " and ".join(f"{c.label} ({c.shown})" for c in right)
    for cell in wrong:
        what = f"wrong {name}: {cell.shown} is {_ordinal(ranked[cell])} of {len(ranked)}"
        yield _found(column, cell, what, f"the mark on {names}")
    for cell in missing:
        if with_mark:
            what = f"tie: {cell.shown} equals the marked {with_mark[0].label}"
            yield _found(column, cell, what, f"the {name} here too")
        elif required and not (wrong or paired or noisy):
            yield _found(column, cell, f"missing {name}", f"{cell.shown} marked as {name.removesuffix(' mark')}")
    # the best row is the second-best one's better, and a best that is marked too claims nothing over it
    rival = next((cell for cell in noisy if cell not in marked), None)
    if rival and with_mark and not paired:
        what = f"claim within noise: {name}, but {rival.label} ({rival.shown}) is not further away"
        yield _found(column, with_mark[0], f"{what} than their intervals", "no mark, or one on both")


def _within_noise(better: Cell, worse: Cell, higher: bool) -> bool:
    """Whether two numbers differ by no more than the root of the sum of squares of the intervals' facing halves."""
    sign = 1 if higher else -1
    facing = better.low if higher else better.high, worse.high if higher else worse.low
    down, up = sign * (better.value - facing[0]), sign * (facing[1] - worse.value)
    # without intervals both are NaN, which `max` keeps and no number is below
    return abs(better.value - worse.value) <= math.hypot(max(down, 0.0), max(up, 0.0))


def _ordinal(rank: int) -> str:
    return f"{rank}{'th' if 10 <= rank % 100 <= 20 else {1: 'st', 2: 'nd', 3: 'rd'}.get(rank % 10, 'th')}"
