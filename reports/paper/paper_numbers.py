"""The paper's numbers as data: `paper_tables.toml` beside this, read.

A number is the text that the paper printed, so that 22.40 stays 22.40.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any

from ihbench.document import document
from ihbench.errors import BadInput
from ihbench.scene.method_spec import method_spec

ABSENT = "--"  # as the paper prints it


@dataclass(frozen=True)
class Digits:
    """How a column writes measured numbers: a number of decimals, or of significant digits."""

    decimals: int | None = None
    significant: int | None = None

    def decimals_of(self, value: float) -> int:
        """Decimals for a finite value. Significant digits never ask for more than three decimals."""
        if self.significant is None:
            return self.decimals or 0
        rounded = abs(float(f"{value:.{self.significant - 1}e}"))
        exponent = math.floor(math.log10(rounded)) if rounded else 0
        return min(max(self.significant - 1 - exponent, 0), 3)


@dataclass(frozen=True)
class Column(document.Column):
    """One metric on one data set, as the paper heads it."""

    digits: Digits

    def rounded(self, value: float) -> float:
        """As it is shown: what is shown alike ranks alike."""
        return round(value, self.digits.decimals_of(value)) if math.isfinite(value) else math.nan

    def text(self, value: float, like: float | None = None) -> str:
        """A value in the column's unit, with the decimals of `like` if given; "—" when absent, "∞" when infinite."""
        if math.isnan(value):
            return "—"
        if math.isinf(value):
            return "∞"
        return f"{value:.{self.digits.decimals_of(value if like is None else like)}f}"


@dataclass(frozen=True)
class Group:
    """Columns of one data set, and the runs that fill them with measured numbers."""

    name: str
    columns: tuple[Column, ...]
    protocols: tuple[str, ...]  # ids without version
    views: str = ""  # the protocol's group of test views; "" for its own
    note: str = ""
    measured_only: bool = False  # the paper has no such columns


@dataclass(frozen=True)
class Component:
    """A part of a method that ablation rows have or have not, told from the switches of a run."""

    name: str
    on: tuple[str, ...] = ()  # switches that must all be on
    several: str = ""  # switch that must hold more than one value
    equal: Mapping[str, str] = field(default_factory=dict)  # switches that must have one value, and that value
    off: tuple[str, ...] = ()  # switches that must be off, or unknown to the run
    measured_only: bool = False


@dataclass(frozen=True)
class PaperCell:
    text: str  # as printed
    status: str  # reported, quoted, unreliable, absent
    footnotes: tuple[str, ...] = ()

    @property
    def value(self) -> float:
        return math.nan if self.text == ABSENT else float(self.text)


@dataclass(frozen=True)
class PaperRow:
    name: str
    cells: tuple[PaperCell, ...]
    section: str = ""
    components: tuple[bool, ...] = ()
    printed: str = ""  # the paper's own mark on this row's numbers: best, second
    source: str = ""  # of a row that another publication prints

    def is_of(self, method: str) -> bool:
        """Whether this is the row of a method, by its name or its title: "3DGS-Avatar" is `3dgs_avatar`, and what
        registers itself as `three-dgs-avatar` under that title."""
        names = {method}
        with suppress(BadInput):
            names.add(method_spec(method).title)
        return _letters(self.name) in map(_letters, names)

    @property
    def own(self) -> bool:
        """The paper about its own method."""
        return any(cell.status == "reported" for cell in self.cells)


@dataclass(frozen=True)
class PaperTable:
    name: str
    title: str
    source: str
    head: str  # of the column of row names
    groups: tuple[Group, ...]
    rows: tuple[PaperRow, ...]
    components: tuple[Component, ...] = ()
    notes: tuple[str, ...] = ()
    footnotes: Mapping[str, str] = field(default_factory=dict)
    elsewhere: tuple[PaperRow, ...] = ()  # rows that other publications print, newer ones included

    @property
    def columns(self) -> tuple[Column, ...]:
        """Those that the paper has."""
        return tuple(column for group in self.groups if not group.measured_only for column in group.columns)


def paper_table(name: str) -> PaperTable:
    """One table of the paper."""
    shipped = files("ihbench.reports.paper") / "paper_tables.toml"
    content = tomllib.loads(shipped.read_text(encoding="utf-8"))
    raw = content[name]
    groups = [
        Group(
            columns=tuple(Column(g["name"], key, Digits(**content["digits"][key])) for key in g["metrics"]),
            **_fields({key: value for key, value in g.items() if key != "metrics"}),
        )
        for g in raw["group"]
    ]
    return PaperTable(
        name=name,
        title=raw["title"],
        head=raw["head"],
        source=f"{content['source']}, {raw['where']}",
        groups=tuple(groups),
        rows=tuple(map(_row, raw["row"])),
        elsewhere=tuple(map(_row, raw.get("elsewhere", ()))),
        components=tuple(Component(**_fields(component)) for component in raw.get("component", ())),
        **_fields({key: raw[key] for key in ("notes", "footnotes") if key in raw}),
    )


def _fields(raw: Mapping[str, Any]) -> Mapping[str, Any]:
    """A part of the file as fields of a dataclass: its lists as tuples."""
    return {key: tuple(value) if isinstance(value, list) else value for key, value in raw.items()}


def _row(raw: Mapping[str, Any]) -> PaperRow:
    own, unreliable, footnotes = raw.get("status", "quoted"), raw.get("unreliable", ()), raw.get("footnotes", {})
    cells = [
        PaperCell(
            text,
            "absent" if text == ABSENT else "unreliable" if k in unreliable else own,
            tuple(footnotes.get(str(k), ())),
        )
        for k, text in enumerate(raw["cells"])
    ]
    components = tuple(raw.get("components", ()))
    more = (raw.get(key, "") for key in ("section", "printed", "source"))
    section, printed, source = more
    return PaperRow(raw["name"], tuple(cells), section, components, printed, source)


def _letters(name: str) -> str:
    return "".join(letter for letter in name.casefold() if letter.isalnum())
