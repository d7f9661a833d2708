"""`ihbench site RUNS --out DIR`: finished runs as one offline page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from ihbench import registry
from ihbench.commands.options.parse import options
from ihbench.commands.report import say_left_out
from ihbench.config_fields import Within
from ihbench.errors import BadInput
from ihbench.record import outputs

if TYPE_CHECKING:
    from ihbench.record.results import RunResult

PAGES = (".html", ".htm")


@dataclass(frozen=True)
class SiteOptions:
    runs: Annotated[tuple[Path, ...], tyro.conf.Positional] = (Path("runs"),)
    """Run folders, or folders of them."""
    out: Path = Path("site")
    """Folder to write; with --single-file the file, or a folder for its index.html."""
    single_file: bool = False
    """One file with everything inside, of at most 25 MB."""
    views: Annotated[int, Within(1, 10_000)] = 12
    """About so many test views of a scene have pictures: spread over all, and the worst. All have their numbers."""
    title: str | None = None
    """Title of the page."""
    share: bool = False
    """For passing on: avatars on a licensed body, whose weights would be in the page, are shown in pictures alone."""
    data: Path | None = None
    """Your copy of the data set, for runs on real data; without it there is no truth beside the predictions."""
    body: Path | None = None
    """SMPL model file, likewise."""


def main(argv: list[str]) -> int:
    chosen = options(SiteOptions, argv, "site", "Finished runs as an offline page that shows them.")
    is_page = chosen.out.suffix in PAGES
    if not chosen.single_file and not chosen.out.is_dir() and (is_page or chosen.out.exists()):
        raise BadInput(f"--out {chosen.out}: expected a folder; for everything in one file add --single-file")
    outputs.check_file(chosen.out, chosen.data, chosen.body, *chosen.runs)
    results, left_out = read_runs(chosen.runs)
    say_left_out(left_out)
    general = registry.load("site", "general")
    more: dict[str, Any] = {} if chosen.title is None else {"title": chosen.title}
    more |= {"share": chosen.share, "data": chosen.data, "body": chosen.body}
    site = general.build(results, left_out, views=chosen.views, **more)
    count = f"{len(results)} run{'s' * (len(results) != 1)}"
    if chosen.single_file:
        file = chosen.out if is_page else chosen.out / "index.html"
        size = general.write_single(site, file)
        print(f"{file}: {size / 2**20:.1f} MB, {count}; open it in a browser, it needs nothing else")
    else:
        print(f"{general.write_folder(site, chosen.out)}: {count}; open it in a browser")
    return 0


def read_runs(places: tuple[Path, ...]) -> tuple[list[RunResult], list[str]]:
    """The runs in these folders, each a run folder or a folder of them, and the folders that are left out. Raises
    `BadInput` where there is none."""
    from ihbench.record.index import Index
    from ihbench.record.results import read_results, without_copies

    results, left_out = [], []
    for place in places:
        if (place / "run.json").is_file():
            more, lines = read_results([place])
        else:
            more, lines = Index(place).results()
        results += more
        left_out += lines
    results, copies = without_copies(results)
    if not results:
        raise BadInput(
            f"no run folders in {', '.join(map(str, places))}; make one with: "
            "ihbench run --protocol zju_occ --scene standin-1"
        )
    return results, [*left_out, *copies]
