"""Timing of kernels side by side, and the memory they take."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from ihbench.clock import machine

Row = dict[str, Any]
UNSTABLE = 0.25  # a spread above this share of the median is marked

Sample = tuple[float, float | None]  # ms forward, ms backward


def timed(step: Callable[[], object]) -> Sample:
    """Milliseconds of something that has no backward pass."""
    start = time.perf_counter()
    step()
    return (time.perf_counter() - start) * 1e3, None


def interleave(steps: dict[str, Callable[[], Sample]], repeats: int, warm_up: int = 2) -> dict[str, list[Sample]]:
    """Time the steps in turn, so that a change of the machine's load meets all of them."""
    for step in steps.values():
        for _ in range(warm_up):
            step()
    timings: dict[str, list[Sample]] = {name: [] for name in steps}
    for _ in range(repeats):
        for name, step in steps.items():
            timings[name].append(step())
    return timings


def summary(samples: list[Sample]) -> Row:
    """Median and interquartile range of forward and backward."""
    row: Row = {"repeats": len(samples), "unstable": False}
    for k, name in enumerate(("forward", "backward")):
        values = [sample[k] for sample in samples]
        if None in values:
            row |= {f"{name}_ms": None, f"{name}_iqr_ms": None}
            continue
        low, median, high = np.percentile(np.array(values, dtype=np.float64), [25, 50, 75])
        row |= {f"{name}_ms": float(median), f"{name}_iqr_ms": float(high - low)}
        row["unstable"] |= bool(high - low > UNSTABLE * median)
    return row


def row_of(
    kernel: str,
    case: str,
    backend: str,
    samples: list[Sample],
    memory: float | None,  # MiB
    error: float | None,
    gradient_error: float | None = None,
    **more: str,
) -> Row:
    """A row of the table."""
    errors = {"value_error": error, "gradient_error": gradient_error}
    of = {"kernel": kernel, "case": case, "backend": backend, **more}
    return {**of, **summary(samples), "peak_mib": memory, **errors}


def peak_mib(step: Callable[[], object]) -> float | None:
    """Memory that a step needs while it runs, in MiB; None where the system cannot say (not Linux with glibc)."""
    try:
        ctypes.CDLL(None).malloc_trim(0)  # give back what earlier steps left, or this one would need nothing new
    except (OSError, AttributeError):
        return None
    before = machine.process_memory_mb("VmRSS")
    if before is None or not machine.reset_peak_memory():
        return None
    step()
    return max(0.0, machine.peak_memory_mb() - before)
