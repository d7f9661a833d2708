"""Running cases, one after the other or side by side."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import cache
from importlib import import_module
from multiprocessing import get_context

from ihbench import registry
from ihbench.clock.interruption import end_with_parent
from ihbench.clock.threads import begin_on_one_thread, one_torch_thread
from ihbench.errors import BadInput
from ihbench.scene.method_spec import usable_specs
from ihbench.stress.case import Answer, Case, Outcome, Verdict, error_of

GROUPS = ("metrics", "geometry", "splat", "data", "training", "ranking")  # a module each, with a list CASES
MODULES = (*GROUPS, "splat_general")  # and one more for a group that grew


def all_cases() -> list[Case]:
    """Every case, group by group: the bench's own, then those of registered methods."""
    cases = [case for module in MODULES for case in import_module(f"ihbench.stress.{module}").CASES]
    for spec in usable_specs():
        cases += spec.load(spec.stress, Sequence, Case) if spec.stress else []
    return sorted(cases, key=lambda case: GROUPS.index(case.group) if case.group in GROUPS else len(GROUPS))


def chosen_cases(groups: Sequence[str] = (), names: Sequence[str] = ()) -> list[Case]:
    """The cases of these groups (of all, where none is named) that have one of these names (any, where none is).

    Raises `BadInput` for a group or a name that does not exist.
    """
    cases = all_cases()
    known = list(dict.fromkeys(case.group for case in cases))
    for group in groups:
        if group not in known:
            raise BadInput(f"stress group {group!r}: {registry.nearest(group, known)}")
    cases = [case for case in cases if not groups or case.group in groups]
    for name in names:
        if name not in (got := [case.name for case in cases]):
            raise BadInput(f"stress case {name!r}: {registry.nearest(name, got)}")
    return [case for case in cases if not names or case.name in names]


def run_cases(
    cases: Sequence[Case], after_each: Callable[[Outcome], None] = lambda outcome: None, workers: int = 1
) -> list[Outcome]:
    """Run cases, on one torch thread; the outcomes are in their order. With several workers registered cases run side
    by side, in as many processes."""
    if workers > 1 and len(cases) > 1:
        return _side_by_side(cases, after_each, min(workers, len(cases)))
    outcomes = []
    with one_torch_thread():
        for case in cases:
            outcomes.append(run_case(case))
            after_each(outcomes[-1])
    return outcomes


def _side_by_side(cases: Sequence[Case], after_each: Callable[[Outcome], None], workers: int) -> list[Outcome]:
    outcomes = []
    with ProcessPoolExecutor(workers, get_context("spawn"), initializer=_begin_worker) as pool:
        # a case is a function, which does not travel: its name does, and its outcome comes back without it
        for case, outcome in zip(cases, pool.map(_run_named, [case.name for case in cases]), strict=True):
            outcomes.append(replace(outcome, case=case))
            after_each(outcomes[-1])
    return outcomes


def _begin_worker() -> None:
    end_with_parent()
    begin_on_one_thread()


def _run_named(name: str) -> Outcome:
    case = _by_name()[name]
    return replace(run_case(case), case=replace(case, function=_elsewhere))


@cache
def _by_name() -> dict[str, Case]:
    return {case.name: case for case in all_cases()}


def _elsewhere() -> Answer:
    raise NotImplementedError("a case that was run in another process")


def run_case(case: Case) -> Outcome:
    """Run one case. An exception or a numerical warning in it is a failure, not the end. What is known excuses a
    wrong answer and a numerical warning, never a crash."""
    start = time.perf_counter()
    value, expected, error, condition, note, known = math.nan, math.nan, math.inf, None, "", case.known
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)
            answer = case.function()
        error, value, expected = error_of(answer, case.unit)
        condition, note = answer.condition, answer.note
        reason = "" if error <= case.tolerance else f"error {error:.3g} beyond {case.tolerance:g} ({case.unit})"
    except Exception as trouble:
        known = case.known if isinstance(trouble, RuntimeWarning) else ""
        first_line = next(iter(str(trouble).splitlines()), "")
        reason = f"raised {type(trouble).__name__}: {first_line}"
    verdict: Verdict = "passed"
    if reason:
        verdict, reason = ("known", f"{known} [{reason}]") if known else ("failed", reason)
    elif case.known:
        note = f"{note}; listed as known to fail, but passes" if note else "listed as known to fail, but passes"
    seconds = time.perf_counter() - start
    return Outcome(case, value, expected, error, condition, verdict, reason, note, seconds)
