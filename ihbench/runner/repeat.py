"""Repeating somebody's run from its record alone: `ihbench run --like RUN`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ihbench.config_fields import flat, with_fields
from ihbench.errors import BadInput
from ihbench.record.finished_run import FinishedRun
from ihbench.record.results import RunResult, read_result
from ihbench.runner.run_loop import RunRequest, configuration


@dataclass(frozen=True)
class Repetition:
    """What a record asks for."""

    request: RunRequest
    scene: str


def repetition(folder: Path, runs: Path, body: Path | None, device: str, force: bool) -> Repetition:
    """The run of a folder once more: its protocol as it was then, its method, every switch, its scene and seed.

    Raises `BadInput` for a folder that holds no run, scored predictions, and a method with other switches by now.
    """
    run = FinishedRun(folder)
    identity = run.record.identity
    if run.record.about.predictions is not None:
        raise BadInput(f"{folder}: holds scored images, not a run of a method; repeat it with ihbench score")
    method, switches = identity.method, identity.switches
    config = configuration(method, identity.profile, {})
    unknown = sorted(switches.keys() - flat(config).keys())
    if unknown:
        raise BadInput(
            f"{folder}: was run with --method.{unknown[0].replace('_', '-')}, which {method} does not have here; "
            f"its code was {identity.code}"
        )
    config, keep = with_fields(config, switches), tuple(identity.config.get("keep", ()))
    request = RunRequest(run.protocol, method, config, identity.seed, device, runs, body, force, keep)
    return Repetition(request, identity.scene)


def differences(folder: Path, result: RunResult) -> list[str]:
    """What the repetition and the run it repeats do not have in common, a line each: code, data, versions, scores."""
    if result.folder.resolve() == folder.resolve():
        return [f"{folder}: is that run itself, and is done; --force runs it again, another --runs beside it"]
    there = read_result(folder)
    lines = []
    for name in ("code", "data", "body"):
        lines += _change(name, getattr(there.identity, name), getattr(result.identity, name))
    lines += _change("outside files", *(r.identity.config.get("outside") for r in (there, result)))
    before, now = (r.record.provenance.packages for r in (there, result))
    for name in sorted(before.keys() | now.keys()):
        lines += _change(name, before.get(name), now.get(name))
    for name in ("cpu", "gpu", "python"):
        lines += _change(name, *(getattr(r.record.machine, name) for r in (there, result)))
    old, new = there.own, result.own
    for identity in sorted(old.keys() | new.keys(), key=str):
        values = [rows[identity].value if identity in rows else None for rows in (old, new)]
        if values[0] != values[1] and not all(value is None or value != value for value in values):
            lines += _change(str(identity), *values)
    return lines or [f"{folder}: the same code, data and versions, and the same scores to the last bit"]


def _change(name: str, before: Any, now: Any) -> list[str]:
    return [] if before == now else [f"{name}: {before} there, {now} here"]
