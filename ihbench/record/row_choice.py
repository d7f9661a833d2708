"""What of a table is written: which rows, in which order and under which names; which metrics; which regions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

from ihbench.errors import BadInput
from ihbench.metrics import Identity, Mean
from ihbench.record.results import Rows, RunResult, by_group
from ihbench.record.row_labels import by_configuration
from ihbench.registry import nearest
from ihbench.scoring.calibration import ROWS

T = TypeVar("T")


@dataclass(frozen=True)
class Choice:
    """Nothing chosen is everything. Bounds (the calibration rows) may be chosen like rows, but keep their names."""

    rows: tuple[str, ...] = ()  # labels; a method that is no row's label stands for all of its rows
    metrics: tuple[str, ...] = ()  # "psnr"
    regions: tuple[str, ...] = ()
    names: tuple[str, ...] = ()  # OLD=NEW

    def check(self, labels: Mapping[str, str], metrics: Iterable[str], regions: Iterable[str]) -> None:
        """Raise `BadInput`, with the nearest known one, for a word that names none of these. `labels`: label of a row
        -> its method."""
        known = list(dict.fromkeys((*labels, *labels.values(), *ROWS)))
        kinds = (("rows", self.rows, known), ("metrics", self.metrics, metrics), ("regions", self.regions, regions))
        for flag, words, having in kinds:
            having = list(dict.fromkeys(having))
            for word in words:
                if word not in having:
                    raise BadInput(f"--{flag} {word}: there is none here: {nearest(word, having)}")
        self.renamed(labels)

    def ordered(self, labels: Mapping[str, str]) -> list[str]:
        """The labels (label -> method) that are wanted, in the order in which they were asked for."""
        if not self.rows:
            return list(labels)
        rows: dict[str, None] = {}
        for word in self.rows:
            named = [word] if word in labels else [label for label, method in labels.items() if method == word]
            rows |= dict.fromkeys(named)
        return list(rows)

    def bounds(self, rows: Sequence[str]) -> list[str]:
        """The calibration rows that are wanted."""
        return [row for row in rows if not self.rows or row in self.rows]

    def has_metric(self, metric: str) -> bool:
        return not self.metrics or metric in self.metrics

    def renamed(self, labels: Iterable[str]) -> dict[str, str]:
        """Label -> its new name. Raises `BadInput` for what is no OLD=NEW of a row, and for one name on two rows."""
        labels = list(labels)
        out: dict[str, str] = {}
        for text in self.names:
            # labels have "=" in them: the longest one that the text begins with
            old = max((label for label in labels if text.startswith(f"{label}=")), key=len, default=None)
            if old is None:
                asked = text.rpartition("=")[0] or text
                if asked in ROWS:
                    raise BadInput(f"--names {text}: {asked} is a bound that the bench computes, and keeps its name")
                raise BadInput(f"--names {text}: expected OLD=NEW with the name of a row: {nearest(asked, labels)}")
            new = text[len(old) + 1 :].strip()
            if not new or new in ROWS:
                raise BadInput(f"--names {text}: expected a name after {old}= that is no bound's; give another")
            out[old] = new
        shown = [out.get(label, label) for label in labels]
        twice = next((name for name in shown if shown.count(name) > 1), None) if out else None
        if twice is not None:
            raise BadInput(f"--names: two rows would be called {twice!r}; give each a name of its own")
        return out

    def applied(self, results: Sequence[RunResult]) -> list[RunResult]:
        """The runs with what is wanted of them, in order. Raises `BadInput` as `check` does."""
        if self == EVERYTHING:
            return list(results)
        groups = by_group(results)
        labelled: list[dict[str, list[RunResult]]] = []
        for runs in groups.values():
            done = [run for run in runs if run.status == "done"]
            labelled.append(by_configuration(done))
        every = [i for run in results for scores in _scores(run) for i in scores]
        labels = {label: runs[0].method for by_label in labelled for label, runs in by_label.items()}
        self.check(labels, [i.metric for i in every], [i.region for i in every])
        names = self.renamed(labels)
        out = []
        for runs, by_label in zip(groups.values(), labelled, strict=True):
            order = self.ordered({label: own[0].method for label, own in by_label.items()})
            out += [self._run(run, names.get(label)) for label in order for run in by_label[label]]
            out += [run for run in runs if run.status != "done" and (not self.rows or run.method in self.rows)]
        return out

    def _run(self, run: RunResult, name: str | None) -> RunResult:
        about = run.about if name is None else replace(run.about, label=name)
        if self.regions and about.headline not in self.regions:
            about = replace(about, headline=self.regions[0])
        return replace(
            run,
            record=replace(run.record, about=about),
            rows=self._rows(run.rows),
            presets={preset: self._rows(rows) for preset, rows in run.presets.items()},
            curve=[replace(point, scores=self._scores(point.scores)) for point in run.curve],
        )

    def _rows(self, rows: Rows) -> Rows:
        return {row: self._scores(scores) for row, scores in rows.items() if row not in ROWS or self.bounds([row])}

    def _scores(self, scores: Mapping[Identity, T]) -> dict[Identity, T]:
        return {
            identity: value
            for identity, value in scores.items()
            if self.has_metric(identity.metric) and (not self.regions or identity.region in self.regions)
        }


EVERYTHING = Choice()


def _scores(run: RunResult) -> Iterable[Mapping[Identity, Mean]]:
    yield from run.rows.values()
    for rows in run.presets.values():
        yield from rows.values()
