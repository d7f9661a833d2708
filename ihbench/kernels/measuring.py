"""Timing of kernels side by side, and the memory they take."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ihbench.clock import machine

UNSTABLE = 0.25  # a spread above this share of the median is marked

Sample = tuple[float, float | None]  # ms forward, ms backward


@dataclass(frozen=True)
class Row:
    """What one back end took for one case, and how far off it was."""

    kernel: str
    case: str
    backend: str
    repeats: int
    unstable: bool
    forward_ms: float  # median
    forward_iqr_ms: float
    backward_ms: float | None  # None where there is no backward pass
    backward_iqr_ms: float | None
    peak_mib: float | None  # that the work needs beside its input
    value_error: float | None  # against the twin
    gradient_error: float | None
    ratio: float = 1.0  # forward time over that of the first back end of its case
    knob: str = ""  # what a case's rows differ in, where that is a setting
    processor_ms: float | None = None  # of all threads, forward and backward; median
    pairs_per_second: float | None = None  # pairs of pixel and splat, forward and backward


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


def row_of(
    kernel: str,
    case: str,
    backend: str,
    samples: list[Sample],
    memory: float | None,  # MiB
    error: float | None,
    gradient_error: float | None = None,
    knob: str = "",
) -> Row:
    """A row of the table: median and interquartile range of forward and backward."""
    times: list[float | None] = []
    unstable = False
    for values in zip(*samples, strict=True):
        if None in values:
            times += [None, None]
            continue
        low, median, high = np.percentile(np.array(values, dtype=np.float64), [25, 50, 75])
        times += [float(median), float(high - low)]
        unstable |= bool(high - low > UNSTABLE * median)
    forward, forward_iqr, backward, backward_iqr = times
    assert forward is not None
    assert forward_iqr is not None
    return Row(
        kernel, case, backend, len(samples), unstable, forward, forward_iqr, backward, backward_iqr, memory, error,
        gradient_error, knob=knob,
    )  # fmt: skip


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
