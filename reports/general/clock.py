"""How far a report's seconds can be trusted: on which machine, beside what load, how far repeats lie apart."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from ihbench.clock.ledger import FIT
from ihbench.clock.machine import BUSY
from ihbench.document.document import Words
from ihbench.metrics.statistics import BOOTSTRAP_FROM, Interval, mean_interval
from ihbench.record.results import RunResult, grouped
from ihbench.record.row_labels import by_label
from ihbench.record.scene_means import seed_means

WAITED = 1.5  # a fit that took more than this times its processor seconds stood still for a part of them
UNSTABLE = 0.25  # repeats further apart than this share of their median are called unstable, as in `ihbench kernels`


def by_machine(runs: Sequence[RunResult]) -> dict[str, list[RunResult]]:
    """Runs by row label; where they were made on several machines, by label and machine (A, B, …).

    Seconds of different machines are never averaged. Runs without a fit (scored predictions) have no seconds and are
    left out.
    """
    timed = [run for run in runs if run.timed]
    letters = machine_letters(timed)
    return grouped(
        (f"{label} on {letters[machine_name(run)]}" if len(letters) > 1 else label, run)
        for label, group in by_label(timed).items()
        for run in group
    )


def machine_letters(runs: Sequence[RunResult]) -> dict[str, str]:
    """Machine -> A, B, … in the order given."""
    names = dict.fromkeys(machine_name(run) for run in runs)
    return {name: chr(ord("A") + k) if k < 26 else f"M{k}" for k, name in enumerate(names)}


def machine_name(run: RunResult) -> str:
    """Processor, cores, threads and device of a run, in words: what must be equal for seconds to be compared."""
    machine = run.record.machine
    words = [machine.cpu or "unknown processor", _counted(machine.cores_usable, "core")]
    if machine.torch_threads is not None:
        words.append(_counted(machine.torch_threads, "thread"))
    if machine.gpu:
        words.append(machine.gpu)
    elif run.about.device != "cpu":
        words.append(f"{run.about.device}, GPU not recorded")
    return ", ".join(words)


def one_clock(runs: Sequence[RunResult]) -> bool:
    """Whether seconds of these runs may be averaged."""
    return len({machine_name(run) for run in runs}) <= 1


def mean_cost(runs: Sequence[RunResult], cost: Callable[[RunResult], float | None]) -> float | None:
    """What these runs cost in seconds or milliseconds, as scores are averaged: the mean over the seeds of a scene,
    then over scenes. None where no run says it, and for runs of several machines."""
    known = seed_means((run.scene, value) for run in runs if (value := cost(run)) is not None)
    return math.fsum(known.values()) / len(known) if known and one_clock(runs) else None


def three_digits(cost: float) -> str:
    """ "0.0152", "65.8", "1061": seconds or milliseconds, never with an exponent where they are many."""
    return f"{cost:.0f}" if abs(cost) >= 999.5 else f"{cost:.3g}"


def positive_interval(seconds: Mapping[str, float | Sequence[float]], level: float) -> Interval:
    """`mean_interval` of seconds, which are positive: Student's t is taken of the mean's logarithm (its deviation is
    that of the mean over the mean), so that no end lies below zero. Resampling needs no logarithm."""
    interval = mean_interval(seconds, level)
    if not (interval.value > 0 and math.isfinite(interval.low) and interval.n < BOOTSTRAP_FROM):
        return interval
    low, high = (interval.value * math.exp(end / interval.value - 1) for end in (interval.low, interval.high))
    return replace(interval, low=low, high=high, method=f"{interval.method}, in log time")


def fit_cpu_seconds(run: RunResult) -> float | None:
    """What the processor did for the fit, seconds of all its threads together; None where the record does not say,
    and for a fit on a GPU, of which it says nothing."""
    stages = {} if run.record.ledger is None else run.record.ledger.stages
    seconds = stages[FIT].cpu_seconds if FIT in stages and run.about.device == "cpu" else 0.0
    return seconds or None


def waited(runs: Sequence[RunResult]) -> str:
    """How many fits stood still while their clock went on, as one does that was stopped or shared its processor:
    "2 of 6 fits waited: up to 845 s, of which the process ran 54 s"; "" for none. Threads work at the same time: of a
    fit with several that waited not all is noticed."""
    timed = [(run.fit_seconds, cpu) for run in runs if run.timed and (cpu := fit_cpu_seconds(run)) is not None]
    found = [(seconds, cpu) for seconds, cpu in timed if seconds > WAITED * cpu]
    if not found:
        return ""
    seconds, cpu = max(found)
    return f"{len(found)} of {len(runs)} fits waited: up to {seconds:.0f} s, of which the process ran {cpu:.0f} s"


def unstable(runs: Sequence[RunResult]) -> list[str]:
    """Why the seconds of these runs (one row of a table) are unstable; nothing when they are not known to be."""
    reasons = [words] if (words := waited(runs)) else []
    apart = max(map(_spread, grouped((run.scene, run.fit_seconds) for run in runs).values()), default=0.0)
    if apart > UNSTABLE:
        reasons.append(f"repeats {apart:.0%} of their median apart")
    loads = [load for load in map(_load_per_core, runs) if load is not None]
    if loads and max(loads) > BUSY:
        busy = sum(load > BUSY for load in loads)
        reasons.append(f"{busy} of {len(runs)} runs on a busy machine (load up to {max(loads):.1f} per core)")
    return reasons


def clock_notes(rows: Mapping[str, Sequence[RunResult]]) -> list[Words]:
    """Machines, loads and what is unstable, as the items of a list."""
    runs = [run for group in rows.values() for run in group]
    letters = machine_letters(runs)
    notes: list[Words] = []
    for name, letter in letters.items():
        here = [run for run in runs if machine_name(run) == name]
        loads = [run.record.machine.load_average[0] for run in here if run.record.machine.load_average]
        load = f"load average at the start {min(loads):.1f} to {max(loads):.1f}" if loads else "load unknown"
        which = f"machine {letter}" if len(letters) > 1 else "machine"
        notes.append(f"{which}: {name}; {load}")
    reasons = grouped((reason, label) for label, group in rows.items() for reason in unstable(group))
    return [*notes, *(f"unstable seconds: {reason}: {'; '.join(labels)}" for reason, labels in reasons.items())]


def _spread(seconds: Sequence[float]) -> float:
    """How far repeats lie apart as a share of their median."""
    middle = statistics.median(seconds)
    return (max(seconds) - min(seconds)) / middle if len(seconds) > 1 and middle > 0 else 0.0


def _load_per_core(run: RunResult) -> float | None:
    """The larger of the loads at the start, which the run has no part in, and at its end, where a run on all cores
    alone brings about 1 per core. Load is the whole machine's, and so are the cores it is divided by."""
    machine = run.record.machine
    loads = [load[0] for load in (machine.load_average, machine.load_average_end) if load]
    return max(loads) / machine.cores if loads and machine.cores else None


def _counted(number: int | None, what: str) -> str:
    return f"{number if number is not None else '?'} {what}{'' if number == 1 else 's'}"
