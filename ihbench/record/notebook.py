"""Runs and tables as a notebook shows them."""

from __future__ import annotations

import io
from base64 import b64encode
from typing import Any

import pandas

from ihbench.document.document import Paragraph, Table, Words, emphasis, strong, write_fragment
from ihbench.document.html import escape
from ihbench.document.metric_names import heads

SHEET_WIDTH = 900  # px at most of a contact sheet, which would make a notebook megabytes large
LINES = 6  # of a long table
NOT_SHOWN = ["digest", "folder", "identity", "protocol", "profile", "data", "absent"]  # long, or said above


def run_html(run: Any) -> str:
    """The headline of one `record.results.RunResult` beside its calibration rows, what it cost, its contact sheet."""
    who = run.identity
    words: list[Words] = [strong(run.method), f" on {run.scene}, seed {run.seed}, {who.protocol}, {who.profile}"]
    if run.about.standin:
        words.append(strong(f" ({run.about.standin})"))
    text = write_fragment([Paragraph(tuple(_flat(words)))], "html")
    if run.status != "done":
        return f"{text}<p>{escape(run.outcome)}</p>"
    shown = [i for i in run.own if i.region == run.headline]
    head: list[Words] = [f"region {run.headline}", *heads(shown).values(), "fit s", "render ms"]
    rows = []
    for name, means in run.rows.items():
        cells = [i.display.text(means[i].value) if i in means else "—" for i in shown]
        costs = [_number(run.about.fit_seconds), _number(run.about.render_ms)] if name == run.method else ["", ""]
        rows.append((name if name == run.method else emphasis(name), *cells, *costs))
    text += write_fragment([Table(tuple(head), tuple(rows))], "html")
    return text + _sheet(run) + f"<p><code>{escape(str(run.folder))}</code></p>"


def _flat(words: list[Words]) -> list:
    return [piece for word in words for piece in (word if isinstance(word, tuple) else (word,))]


def _number(value: float | None) -> str:
    return "—" if value is None else f"{value:.3g}"


def _sheet(run: Any) -> str:
    """The contact sheet as an image, smaller where it is large; nothing where it cannot be read."""
    from PIL import Image

    try:
        with Image.open(run.folder / "contact_sheet.png") as sheet:
            small = sheet.convert("RGB")
        small.thumbnail((SHEET_WIDTH, 100_000))
        buffer = io.BytesIO()
        small.save(buffer, "JPEG", quality=88)
    except (OSError, ValueError, Image.DecompressionBombError):
        return ""
    data = b64encode(buffer.getvalue()).decode("ascii")
    return f'<p><img alt="contact sheet" style="max-width: 100%" src="data:image/jpeg;base64,{data}"></p>'


class RunFrame(pandas.DataFrame):
    """The tidy table of `ihbench.frame`. A notebook shows its means first; whatever is taken from it is an ordinary
    DataFrame."""

    @property
    def _constructor(self) -> type[pandas.DataFrame]:
        return pandas.DataFrame

    def _repr_html_(self) -> str:
        runs = self["digest"].nunique()
        parts = [f"<p><strong>{len(self)} lines of {runs} run{'s' * (runs != 1)}</strong></p>"]
        groups: Any = self.groupby(["protocol", "profile", "data"], sort=False)
        for (protocol, profile, data), group in groups:
            parts.append(f"<p>{escape(f'{protocol}, {profile}, {data}')}: means over views, then over runs</p>")
            parts.append(means_of(group).to_html(float_format="{:.4g}".format, na_rep="—", border=0))
        few = pandas.DataFrame(self).head(LINES).drop(columns=NOT_SHOWN)
        parts.append(few.to_html(index=False, float_format="{:.4g}".format, na_rep="—", border=0))
        if left_out := self.attrs.get("left_out"):
            parts.append("<p>left out: " + "<br>".join(map(escape, left_out)) + "</p>")
        return "\n".join(parts)


def means_of(table: pandas.DataFrame) -> pandas.DataFrame:
    """Row × (metric, region): the mean over the views of each run, then over runs; NaN where no view has a number.
    The same in several variants of a metric stands under the name of its identity."""
    named: Any = table.assign(metric=_told_apart(table))
    by_run = named.groupby(["row", "metric", "region", "digest"], sort=False)["value"].mean()
    means = by_run.groupby(level=["row", "metric", "region"], sort=False).mean().unstack(["metric", "region"])
    by_metric = [(m, r) for m in dict.fromkeys(named["metric"]) for r in dict.fromkeys(named["region"])]
    known = [column for column in by_metric if column in means.columns]
    return means[known].dropna(axis="columns", how="all")


def _told_apart(table: pandas.DataFrame) -> pandas.Series:
    """The metric's name, or where one name and region has several identities, the identity without its region."""
    lines: Any = table
    several = lines.groupby(["metric", "region"])["identity"].transform("nunique") > 1
    return lines["metric"].where(~several, lines["identity"])
