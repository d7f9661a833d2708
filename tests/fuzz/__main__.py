"""`python -m tests.fuzz [readers|options|records] --n N --seed S`: damaged files, bad words, damaged run folders.

Prints a line for each fault and ends with 1 if there was one. N cases of each kind; the tests run a few hundred.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path

KINDS = ("readers", "options", "records")


def faults(kind: str, folder: Path, n: int, seed: int) -> Iterator[str]:
    """What goes wrong in `n` cases of a kind, a line each. `folder` is empty, and left in any state."""
    find: Callable[[Path, int, int], Iterator[str]] = import_module(f"tests.fuzz.{kind}").faults
    yield from find(folder, n, seed)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz")
    parser.add_argument("kinds", nargs="*", metavar="|".join(KINDS))
    parser.add_argument("--n", type=int, default=1000, help="cases of each kind")
    parser.add_argument("--seed", type=int, default=0)
    words = parser.parse_args()
    found = 0
    for kind in words.kinds or KINDS:
        with tempfile.TemporaryDirectory(prefix="ihbench-fuzz-") as folder:
            for fault in faults(kind, Path(folder), words.n, words.seed):
                found += 1
                print(f"{kind}: {fault}", flush=True)
        print(f"{kind}: {words.n} cases with seed {words.seed}", file=sys.stderr)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
