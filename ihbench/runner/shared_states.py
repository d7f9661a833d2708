"""Saved states that one run takes from another: the rungs of an ablation often begin alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ihbench.clock.checkpoints import saved_meta, state_file
from ihbench.clock.events import Event
from ihbench.clock.machine import Machine
from ihbench.config_fields import as_json
from ihbench.errors import BadInput
from ihbench.files import atomic
from ihbench.record.schema import RunIdentity
from ihbench.record.store import RunFolder

SAME_CLOCK = ("cpu", "gpu", "torch_threads")  # of a machine's identity: the state's seconds come with it


def reusable_run(runs: Path, borrower: RunFolder, state: str, free: Sequence[str], here: Machine) -> RunFolder | None:
    """A finished run under `runs` that has `state`, was made on such a machine as `here` with as many threads, and
    whose identity differs from the borrower's at most in configuration fields whose names begin with one of `free`;
    None when there is none, or nothing is missing."""
    if state_file(borrower.path, state).is_file():
        return None
    key = _key(borrower, free)
    for file in sorted(state_file(folder, state) for folder in Path(runs).glob("*/") if folder != borrower.path):
        if file.is_file():
            try:
                other = RunFolder.open(file.parent.parent)
            except BadInput:
                continue  # a damaged record vouches for nothing
            there = other.record.machine
            alike = all(getattr(there, name) == getattr(here, name) for name in SAME_CLOCK)
            if alike and other.status == "done" and _key(other, free) == key and _last_step(file) is not None:
                return other
    return None


def reuse_state(other: RunFolder, borrower: RunFolder, state: str) -> list[Event]:
    """Copy the state, and the points of the quality-time curve up to it. Gives the ledger's events of that stage."""
    target = state_file(borrower.path, state)
    atomic.write_bytes(target, state_file(other.path, state).read_bytes())
    last = _last_step(target) or 0
    try:
        points = [point for point in other.curve() if point.step <= last]
    except BadInput:  # a damaged curve is of no use, the state is
        points = []
    atomic.write_json_lines(borrower.path / "curve.jsonl", as_json(points))
    return [event for event in other.record.events if event.data.get("stage") == state]


def _last_step(file: Path) -> int | None:
    """The step that a saved state was taken at; None for a damaged file, which nobody should borrow."""
    try:
        return int(saved_meta(file)["step"])
    except Exception:  # whatever a damaged file makes of the reader
        return None


def _key(run: RunFolder, free: Sequence[str]) -> RunIdentity:
    config = {name: value for name, value in run.identity.switches.items() if not name.startswith(tuple(free))}
    kept = [name for name in run.identity.config.get("keep", ()) if not name.startswith(tuple(free))]
    return replace(run.identity, config={**config, "keep": kept, "outside": run.identity.config.get("outside")})
