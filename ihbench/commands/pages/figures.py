"""`ihbench figures`: figures as papers have them, from finished runs, at print resolution."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ihbench import registry
from ihbench.commands.options.parse import options
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
    """The finished runs that are asked for, in a settled order."""
    from ihbench.record.results import read_results

    named = chosen.run or (Path("runs"),)
    folders: list[Path] = []
    for folder in named:
        if (folder / "run.json").is_file() or not folder.is_dir():
            folders.append(folder)
        else:
            folders += sorted(path.parent for path in folder.glob("*/run.json"))
    results, _ = read_results(folders) if folders else ([], [])
    wanted = [
        result
        for result in results
        if result.scene in (chosen.scene or (result.scene,)) and result.method in (chosen.method or (result.method,))
    ]
    done = [result.folder for result in wanted if result.status == "done"]
    if not done:
        where = ", ".join(map(str, named))
        raise BadInput(
            f"{where}: no finished run matches; make one with: ihbench run --protocol zju_occ --scene standin-1"
        )
    return done
