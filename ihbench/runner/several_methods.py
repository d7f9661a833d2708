"""Several methods on the same scenes, one after another: one that cannot run there takes no other along."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from ihbench.clock.failures import one_line
from ihbench.clock.progress import Progress
from ihbench.errors import BadInput
from ihbench.record.provenance import command
from ihbench.record.results import NotRun, RunResult, read_result
from ihbench.runner.run_loop import RunRequest, configuration, run_identity, run_scene
from ihbench.scene.data_source import DataSource
from ihbench.scene.protocol import Protocol

if TYPE_CHECKING:
    from ihbench.body import Body
    from ihbench.scene.contracts import Capture

ONE = "--method"


@dataclass(frozen=True)
class SeveralMethods:
    """What all of them are run with; each has the protocol's profile of its own as it is."""

    protocol: Protocol
    methods: tuple[str, ...]  # registered names
    seeds: tuple[int, ...] = (0,)
    device: str = "cpu"
    runs: Path = Path("runs")
    body: Path | None = None
    force: bool = False
    keep: tuple[str, ...] = ()  # nothing, or "all"
    command: tuple[str, ...] = field(default_factory=command)  # that named all of them


def run_methods(
    asked: SeveralMethods, source: DataSource, progress: Progress
) -> tuple[list[RunResult], list[NotRun]]:
    """Results, and what came to none: scenes outermost, so that what is there early compares the methods.

    Interrupted, the same call finds what is done and goes on. Raises `BadInput` for a scene that cannot be opened.
    """
    results: list[RunResult] = []
    not_run: list[NotRun] = []
    for scene in source.scenes:
        capture, body = source.open(scene, asked.body, progress)
        for method in asked.methods:
            for seed in asked.seeds:
                progress.say(
                    f"{asked.protocol.name} {scene}: {method}, {asked.protocol.profile} profile, seed {seed}"
                )
                outcome = _attempt(asked, method, seed, source, capture, body, progress)
                if isinstance(outcome, RunResult):
                    results.append(outcome)
                    said = outcome.outcome if outcome.status != "done" else ""
                else:
                    not_run.append(NotRun(asked.protocol.name, asked.protocol.profile, method, scene, seed, outcome))
                    said = f"not run: {outcome}"
                if said:
                    progress.say(f"{method} on {scene}: {said}")
    return results, not_run


def _attempt(
    asked: SeveralMethods,
    method: str,
    seed: int,
    source: DataSource,
    capture: Capture,
    body: Body,
    progress: Progress,
) -> RunResult | str:
    """How one run ended, as its folder has it; where it has no folder, why."""
    request = None
    try:
        config = configuration(method, asked.protocol.profile, {})
        request = RunRequest(
            asked.protocol, method, config, seed, asked.device, asked.runs, asked.body, asked.force, asked.keep,
            command=alone(asked.command, method),
        )  # fmt: skip
        return run_scene(request, source, capture.name, progress)
    except Exception as error:
        why = str(error) if isinstance(error, BadInput) else one_line(f"{type(error).__name__}: {error}")
        recorded = None if request is None else _recorded(request, capture, body)
        return recorded if recorded is not None and recorded.status != "running" else why


def _recorded(request: RunRequest, capture: Capture, body: Body) -> RunResult | None:
    """What is on record of a run that was refused on the way."""
    try:
        folder = request.runs / run_identity(request, capture, body).folder_name
        return read_result(folder) if (folder / "run.json").is_file() else None
    except BadInput:
        return None


def alone(words: Sequence[str], method: str) -> tuple[str, ...]:
    """A command line that names several methods as one of them would be run."""
    out: list[str] = []
    naming = False
    for word in words:
        if word == ONE or word.startswith(f"{ONE}="):
            naming = word == ONE
            out += [ONE, method]
        elif not naming or word.startswith("--"):
            naming = False
            out.append(word)
    return tuple(out)
