"""`ihbench kernels`: work-precision of the bench's own kernels."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ihbench.bounds import Within
from ihbench.commands.options.parse import options


@dataclass(frozen=True)
class KernelOptions:
    kernel: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Kernels to measure; none means all."""
    figure: Path | None = None
    """Folder for the work-precision diagram: PNG, SVG, and the numbers as CSV."""
    repeats: Annotated[int, Within(1, 10_000)] = 15
    """How often each is timed."""
    json: bool = False
    """Print one JSON object on stdout."""


def main(argv: list[str]) -> int:
    chosen = options(
        KernelOptions, argv, "kernels", "Error against the float64 oracle, and milliseconds, per back end."
    )
    from ihbench.kernels.table import run_kernels

    run_kernels(chosen.kernel, chosen.json, chosen.repeats, chosen.figure)
    return 0
