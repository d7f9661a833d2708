"""`ihbench figures`: figures as papers have them, from finished runs, at print resolution."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ihbench import registry
from ihbench.commands.options.parse import options
from ihbench.commands.report import say_left_out
from ihbench.errors import BadInput
from ihbench.record import outputs


@dataclass(frozen=True)
class FiguresOptions:
    kind: Annotated[str, tyro.conf.Positional]
    """Which figure: `ihbench figures list` names them."""
    run: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Run folders; or one folder of run folders, which means every finished run in it."""
    views: int = 2
    """Test views of each person, evenly spread; for inpaint the training views of which most was painted."""
    scene: tuple[str, ...] = ()
    """Only these people."""
    method: tuple[str, ...] = ()
    """Only these methods."""
    data: Path | None = None
    """Your copy of the data set, for runs on real data."""
    body: Path | None = None
    """SMPL model file, likewise."""
    out: Path = Path("figures")
    """Folder for NAME.png (300 dpi), NAME.pdf and NAME.txt, the caption: people, views and seeds."""


def main(argv: list[str]) -> int:
    kinds = registry.names("paper figure")
    about = f"Figures as papers have them, from finished runs: {', '.join(kinds)}."
    chosen = options(FiguresOptions, argv, "figures", about)
    if chosen.kind == "list":
        for name in kinds:
            print(f"{name:<12}{(registry.load('paper figure', name).__doc__ or '').split('. ')[0].splitlines()[0]}")
        return 0
    registry.entry_point("paper figure", chosen.kind)  # a misspelt name is told before anything is read
    if chosen.views < 1:
        raise BadInput(f"--views: expected a positive number, got {chosen.views}")
    from ihbench.record.finished_run import FinishedRun

    runs = [FinishedRun(folder, chosen.data, chosen.body) for folder in _folders(chosen)]
    sheet = registry.load("paper figure", chosen.kind)(runs, chosen.views)
    for suffix, content in sheet.files().items():
        outputs.write_bytes(chosen.out / f"{chosen.kind}{suffix}", content)
    print(f"{chosen.out / chosen.kind}.png, .pdf, .txt")
    print(sheet.caption)
    return 0


def _folders(chosen: FiguresOptions) -> list[Path]:
    """The finished runs that are asked for, in a settled order; what is left out of them is said on stderr. Raises
    `BadInput` for a person or a method of which there is no run, and where none is finished."""
    from ihbench.record.results import read_results

    named = chosen.run or (Path("runs"),)
    folders: list[Path] = []
    for folder in named:
        if (folder / "run.json").is_file() or not folder.is_dir():
            folders.append(folder)
        else:
            folders += sorted(path.parent for path in folder.glob("*/run.json"))
    results, left_out = read_results(folders) if folders else ([], [])
    wanted = results
    for name, words in (("scene", chosen.scene), ("method", chosen.method)):
        known = sorted({getattr(result, name) for result in results})
        for word in words if results else ():
            if word not in known:
                raise BadInput(f"--{name} {word}: no run here has it: {registry.nearest(word, known)}")
        wanted = [result for result in wanted if not words or getattr(result, name) in words]
    done = [result.folder for result in wanted if result.status == "done"]
    say_left_out([*left_out, *(f"{result.folder}: {result.outcome}" for result in wanted if result.status != "done")])
    if not done:
        where = ", ".join(map(str, named))
        raise BadInput(
            f"{where}: no finished run matches; make one with: ihbench run --protocol zju_occ --scene standin-1"
        )
    return done
