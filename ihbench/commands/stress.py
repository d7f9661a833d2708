"""`ihbench stress`: the stiff and extreme cases, case by case."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Annotated

import tyro

from ihbench.commands.options.parse import options
from ihbench.commands.options.printing import Printing
from ihbench.config_fields import Within


@dataclass(frozen=True)
class StressOptions(Printing):
    group: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Groups to run: metrics, geometry, splat, data, training, ranking; none means all."""
    case: tuple[str, ...] = ()
    """Only the cases of these names."""
    workers: Annotated[int, Within(1, 1024)] = 1
    """Processes that run cases side by side."""


def main(argv: list[str]) -> int:
    chosen = options(
        StressOptions, argv, "stress",
        "Stiff and extreme cases with known answers; status 1 if one fails that is not listed as known.",
    )  # fmt: skip
    from ihbench.clock.progress import Progress
    from ihbench.stress.run import chosen_cases, run_cases
    from ihbench.stress.table import blocks_of, data_of, failures

    start = os.times()
    cases = chosen_cases(chosen.group, chosen.case)
    with Progress().task("stress", len(cases)) as task:
        outcomes = run_cases(cases, lambda outcome: task.advance(), chosen.workers)
    end = os.times()
    seconds = end.elapsed - start.elapsed, sum(end[:4]) - sum(start[:4])  # of ended workers, too
    chosen.show(data_of(outcomes, *seconds), blocks_of(outcomes, *seconds))
    return 1 if failures(outcomes) else 0
