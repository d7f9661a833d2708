"""`ihbench kernels`: work-precision of the bench's own kernels."""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ihbench.commands.options.parse import options
from ihbench.commands.options.printing import Printing
from ihbench.config_fields import Within


@dataclass(frozen=True)
class KernelOptions(Printing):
    kernel: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Kernels to measure; none means all."""
    figure: Path | None = None
    """Folder for the work-precision diagram: PNG, SVG, and the numbers as CSV."""
    repeats: Annotated[int, Within(1, 10_000)] = 15
    """How often each is timed."""


def main(argv: list[str]) -> int:
    chosen = options(
        KernelOptions, argv, "kernels", "Error against the float64 oracle, and milliseconds, per back end."
    )
    from ihbench.clock import machine
    from ihbench.kernels.table import blocks_of, run_kernels

    rows = run_kernels(chosen.kernel, chosen.repeats)
    here = machine.identity()
    chosen.show({"machine": asdict(here), "rows": [asdict(row) for row in rows]}, blocks_of(here, rows))
    if chosen.figure is not None:
        from ihbench.kernels.figure import draw

        print(f"diagram: {draw(rows, here, chosen.figure)}, with the same name .svg and .csv", file=sys.stderr)
    return 0
