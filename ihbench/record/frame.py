"""Runs as one tidy table: a line for every test view, row and metric, for what no report asks."""

from __future__ import annotations

import io
import math
import os
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

from ihbench.document.csv import harmless
from ihbench.errors import BadInput, MissingPrerequisite, visible
from ihbench.files import atomic
from ihbench.files.paths import user_path
from ihbench.record.index import Index
from ihbench.record.results import RunResult, read_results
from ihbench.record.schema import score_lines

if TYPE_CHECKING:
    import pandas

FILES = ("scores.jsonl", "calibration.jsonl")
COLUMNS = (
    "method", "scene", "seed", "protocol", "profile", "data", "digest", "row", "camera", "frame", "metric", "region",
    "identity", "value", "absent", "folder",
)  # fmt: skip


def frame(runs: Path | str | Iterable[Path | str]) -> pandas.DataFrame:
    """The finished runs of a folder of runs, or one run folder or several, view by view: a line for each method,
    scene, seed, protocol, profile, row, camera, frame and metric.

    `identity` is the metric's with its region, `value` is in the metric's own unit (dB for PSNR), NaN where it is
    absent, and `absent` then says why; `digest` names the run. What cannot be read is left out: its lines stand in
    `.attrs["left_out"]`. A notebook shows the means first. Raises `BadInput` where there is no such folder, or
    none of those named can be read.
    """
    if isinstance(runs, str | os.PathLike):
        folder = user_path(runs)
        return frame_of(*(read_results([folder]) if (folder / "run.json").is_file() else Index(folder).results()))
    try:
        folders = [user_path(folder) for folder in runs]
    except TypeError as error:
        raise BadInput(f"runs {runs!r:.60}: expected a folder of runs, or several run folders") from error
    return frame_of(*read_results(folders))


def frame_of(results: Sequence[RunResult], left_out: Sequence[str] = ()) -> pandas.DataFrame:
    """As `frame`, of runs that are read."""
    from ihbench.record.notebook import RunFrame

    lines = chain.from_iterable(_lines(run) for run in results if run.status == "done")
    table = RunFrame.from_records(list(lines), columns=list(COLUMNS))
    table.attrs["left_out"] = list(left_out)
    return table


def write_frame(table: pandas.DataFrame, file: Path) -> None:
    """As CSV or Parquet, by the file's suffix; the CSV's texts are harmless to spreadsheets. Raises `BadInput` for
    another suffix, `MissingPrerequisite` for Parquet without a package that writes it."""
    check_suffix(file)
    parquet, buffer, shown = file.suffix == ".parquet", io.BytesIO(), table.copy(deep=False)
    clean = visible if parquet else harmless
    for name in table.columns.difference(("seed", "frame", "value")):
        shown[name] = table[name].map(cache(clean))
    if parquet:
        shown.to_parquet(buffer, index=False)
    else:
        shown.to_csv(buffer, index=False, lineterminator="\n")
    atomic.write_bytes(file, buffer.getvalue())


def check_suffix(file: Path) -> None:
    """Raises as `write_frame` does, before any work."""
    if file.suffix not in (".csv", ".parquet") and not atomic.is_stream(file):
        raise BadInput(f"--out {file}: expected a name that ends in .csv or .parquet")
    if file.suffix == ".parquet":
        from importlib.util import find_spec

        if not any(map(find_spec, ("pyarrow", "fastparquet"))):
            raise MissingPrerequisite(f"{file}: Parquet needs a package that is not here: pip install pyarrow")


def _lines(run: RunResult) -> Iterator[tuple[object, ...]]:
    identity = run.identity
    named = (run.method, run.scene, run.seed, identity.protocol, identity.profile, run.data, run.record.digest)
    for file in (run.folder / name for name in FILES):
        for line in score_lines(file) if file.is_file() else ():
            view = line.row, str(line.camera), line.frame
            for metric, value in line.scores.items():
                absent = line.absent.get(str(metric), "") if math.isnan(value) else ""
                what = metric.metric, metric.region, str(metric)
                yield (*named, *view, *what, float(value), absent, str(run.folder))
