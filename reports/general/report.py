"""The registered reports: the general report in Markdown, LaTeX and HTML."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from ihbench.document import document
from ihbench.document.short_names import LONG, with_short_names
from ihbench.record.quality_time import Target
from ihbench.record.results import RunResult
from ihbench.record.shareable import shareable, without_places
from ihbench.reports.general.content import general_report, score_tables
from ihbench.reports.general.headline import headline_section


def write(
    form: str,  # md, tex or html
    results: Sequence[RunResult],
    presets: Sequence[str] = (),
    *,
    targets: Sequence[Target] = (),
    pictures: Sequence[tuple[Path, str]] = (),  # file, caption
    folder: Path = Path("."),  # where the text will lie; a page needs nothing beside it
    left_out: Sequence[str] = (),  # folders, with the reasons
    fragment: bool = False,  # the tables of scores alone, without a document around them
) -> str:
    """The report of these runs; see `general_report`. In LaTeX all row names are short, their switches stand below.

    No text of it names a place of this machine.

    A page has the headline on top, the runs' own pictures in it, and diagrams: the ones given, else its own."""
    results, left_out = shareable(results), [without_places(line) for line in left_out]
    longest = 0 if form == "tex" else LONG
    if fragment:
        return document.write_fragment(with_short_names(score_tables(results, presets), longest), form)
    with TemporaryDirectory() as name:
        if form == "html":
            from ihbench.reports.general.figures import draw
            from ihbench.reports.general.run_pictures import run_pictures

            pictures = [*(pictures or draw(results, Path(name))), *run_pictures(results)]
        top = headline_section(results) if form == "html" else []
        blocks = [*top, *general_report(results, presets, targets, pictures, left_out)]
        return document.write(with_short_names(blocks, longest), form, folder)


MARKDOWN, LATEX, HTML = (partial(write, form) for form in ("md", "tex", "html"))
