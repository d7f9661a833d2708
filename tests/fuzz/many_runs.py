"""`python -m tests.fuzz.many_runs [N]`: processor seconds of `ihbench report` over N runs, and over a tenth of them.

Three kinds of stores: few rows with many seeds, many rows with few seeds, a row for every run. Each is reported when
it has no index, when nothing has changed since, and when one run has.
"""

from __future__ import annotations

import io
import os
import sys
import time
from contextlib import redirect_stdout
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

from ihbench.cli import main
from ihbench.record import index
from tests.fuzz.records import make_run

SHAPES = {  # of the k-th run: method, scene, seed, changed switches
    "10 rows": lambda k: (f"m{k % 10}", f"s{k // 10 % 6}", k // 60, {}),
    "a row in 18 runs": lambda k: ("m", f"s{k % 6}", k // 6 % 3, {"steps": k // 18}),
    "a row each": lambda k: ("m", "s", 0, {"steps": k}),
}


def measure(n: int) -> None:
    for shape, named in SHAPES.items():
        for count in (n // 10, n):
            with TemporaryDirectory() as name, patch.object(os, "fsync"), patch.object(index, "FRESH", 0):
                store = Path(name)
                folders = [make_run(store, *named(k)) for k in range(count)]
                seconds = [_report(store)]
                seconds.append(_report(store))
                (folders[0] / "curve.jsonl").unlink()
                seconds.append(_report(store))
            told = ", ".join(
                f"{s:.2f} s {w}" for s, w in zip(seconds, ("without index", "again", "one changed"), strict=True)
            )
            print(f"{shape:18}{count:6} runs: {told}", flush=True)


def _report(store: Path) -> float:
    began = time.process_time()
    with redirect_stdout(io.StringIO()):
        assert main(["report", "--runs", str(store)]) == 0
    return time.process_time() - began


if __name__ == "__main__":
    measure(int(sys.argv[1]) if len(sys.argv) > 1 else 3000)
