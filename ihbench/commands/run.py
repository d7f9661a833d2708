"""`ihbench run --protocol P`: the main job."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, make_dataclass
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from ihbench import registry
from ihbench.commands.options.device import check_device
from ihbench.commands.options.keep import check_keep
from ihbench.commands.options.parse import options
from ihbench.commands.options.scene_choice import DEFAULT_METHOD, RunsFolder, ScenesChoice
from ihbench.commands.report import headline
from ihbench.config_fields import SEEDS, refuse_repeated
from ihbench.errors import BadInput
from ihbench.scene.method_spec import method_spec

if TYPE_CHECKING:
    from ihbench.record.results import NotRun, RunResult

EVERY_METHOD = "all"


@dataclass(frozen=True, kw_only=True)
class Fitting:
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to fit."""
    force: bool = False
    """Run again even if the same run is done."""
    full: bool = False
    """Print the whole report in Markdown, and not the headline table alone."""


@dataclass(frozen=True, kw_only=True)
class RunOptions(ScenesChoice, Fitting):
    method: tuple[str, ...] = (DEFAULT_METHOD,)
    """A registered method (`ihbench list methods`), or several, or "all": every registered one, a variant that is
    registered under a name of its own (occgauhuman) included. Several are run one after another, each with its own
    profile; --method.* switches are those of one method, so they go with one alone. A method that cannot run on a
    scene has its reason in the table, and the others go on."""
    seed: Annotated[tuple[int, ...], SEEDS] = (0,)
    """Seeds; each is a run of its own."""
    keep: tuple[str, ...] = ()
    """Switches that the plan must not change for this scene; "all" keeps everything."""
    like: Path | None = None
    """Repeat the run in this folder, from its record: protocol, method, switches, scene and seed are its own. Beside
    it only --data, --body, --runs, --device, --force and --json."""


@dataclass(frozen=True, kw_only=True)
class LikeOptions(RunsFolder, Fitting):
    like: Path
    """The folder of the run to repeat."""


def main(argv: list[str]) -> int:
    if _peek(argv, "--like"):
        return _repeat(options(LikeOptions, argv, "run", "Repeat a run from its record."))
    about = "Fit a method, or several, under a protocol and score it."
    methods, profile = _peek(argv, "--method") or [DEFAULT_METHOD], _peek(argv, "--profile") or ["quick"]
    if len(methods) == 1 and methods != [EVERY_METHOD]:
        return _run(options(_with_switches(methods[0], profile[0]), argv, "run", about))
    for word in argv:
        if word.startswith("--method."):
            flag = word.partition("=")[0]
            raise BadInput(
                f"{flag}: a switch of one method, and --method names {' '.join(methods)}; "
                f"run the method that it is of alone: --method NAME {flag} ..."
            )
    return _run_several(options(RunOptions, argv, "run", about))


def _peek(argv: list[str], flag: str) -> list[str]:
    """The values of a flag that decides which other flags exist; none where it is not there."""
    for k, word in enumerate(argv):
        if word == flag:
            return list(takewhile(lambda value: not value.startswith("--"), argv[k + 1 :]))
        if word.startswith(flag + "="):
            return [word.partition("=")[2]]
    return []


def _with_switches(method: str, profile: str) -> type[RunOptions]:
    """`RunOptions` plus the method's own configuration as `--method.*` flags."""
    config = method_spec(method).profile(profile)
    switches = Annotated[type(config), tyro.conf.arg(name="method")]
    return make_dataclass(
        "RunOptions", [("config", switches, field(default=config))], bases=(RunOptions,), frozen=True, kw_only=True
    )


def _run(chosen: Any) -> int:
    """One method, with switches."""
    _check(chosen)
    check_keep(chosen.keep, chosen.config)
    from dataclasses import replace

    from ihbench.clock.progress import Progress
    from ihbench.runner.run_loop import RunRequest, run_scene
    from ihbench.scene.data_source import locate
    from ihbench.scene.protocol import load_protocol

    (method,) = chosen.method
    progress = Progress()
    results = []
    for protocol in chosen.apply(load_protocol(chosen.protocol, chosen.profile)):
        source = locate(protocol, chosen.data, chosen.scene)
        request = RunRequest(
            protocol, method, chosen.config, 0, chosen.device, chosen.runs, chosen.body, chosen.force, chosen.keep
        )
        for scene in source.scenes:
            for seed in chosen.seed:
                progress.say(f"{protocol.name} {scene}: {method}, {chosen.profile} profile, seed {seed}")
                results.append(run_scene(replace(request, seed=seed), source, scene, progress))
    return _print(results, chosen)


def _run_several(chosen: RunOptions) -> int:
    """Several methods, each with its profile as it is; scenes outermost, so that an early table compares them."""
    _check(chosen)
    methods = _named_methods(chosen.method)
    if any(name != "all" for name in chosen.keep):
        raise BadInput(f"--keep {' '.join(chosen.keep)}: switches of one method; with several only --keep all")
    from ihbench.clock.progress import Progress
    from ihbench.runner.several_methods import SeveralMethods, run_methods
    from ihbench.scene.data_source import locate
    from ihbench.scene.protocol import load_protocol

    progress = Progress()
    results: list[RunResult] = []
    not_run: list[NotRun] = []
    for protocol in chosen.apply(load_protocol(chosen.protocol, chosen.profile)):
        source = locate(protocol, chosen.data, chosen.scene)
        asked = SeveralMethods(
            protocol, methods, chosen.seed, chosen.device, chosen.runs, chosen.body, chosen.force, chosen.keep
        )
        finished, missing = run_methods(asked, source, progress)
        results += finished
        not_run += missing
    reasons = {missing.reason for missing in not_run}
    if not results and len(reasons) == 1:  # it is not the methods
        raise BadInput(reasons.pop())
    return _print(results, chosen, not_run)


def _check(chosen: RunOptions) -> None:
    """What must be right before anything is fitted."""
    check_device(chosen.device)
    registry.entry_point("report", "md")  # another package may claim the name
    if not chosen.seed:
        raise BadInput("--seed: expected one number or more")
    refuse_repeated(chosen.seed, "--seed")


def _named_methods(names: Sequence[str]) -> tuple[str, ...]:
    """Registered methods by their names. Raises `BadInput` for an unknown or repeated one."""
    registered = registry.names("method")
    if EVERY_METHOD in names:
        if len(names) > 1:
            raise BadInput(f"--method {' '.join(names)}: {EVERY_METHOD} is every method; name it alone")
        return tuple(registered)
    refuse_repeated(names, "--method")
    for name in names:
        registry.entry_point("method", name)
    return tuple(names)


def _repeat(chosen: LikeOptions) -> int:
    check_device(chosen.device)
    registry.entry_point("report", "md")
    from ihbench.clock.progress import Progress
    from ihbench.runner.repeat import differences, repetition
    from ihbench.runner.run_loop import run_scene
    from ihbench.scene.data_source import locate

    progress = Progress()
    again = repetition(chosen.like, chosen.runs, chosen.body, chosen.device, chosen.force)
    request, scene = again.request, again.scene
    progress.say(f"{request.protocol.name} {scene}: {request.method} as in {chosen.like}, seed {request.seed}")
    result = run_scene(request, locate(request.protocol, chosen.data, (scene,)), scene, progress)
    for line in differences(chosen.like, result):
        progress.say(f"repeated: {line}")
    return _print([result], chosen)


def _print(results: list[RunResult], chosen: Any, not_run: Sequence[NotRun] = ()) -> int:
    from ihbench.record.results import summary

    if chosen.json:
        print(json.dumps(summary(results, not_run), allow_nan=False))
    elif not chosen.full:
        print(headline(results, not_run=not_run), end="")
    else:
        print(registry.load("report", "md")(results))
        for missing in not_run:
            print(f"{missing.method} on {missing.scene}: not run: {missing.reason}")
        for result in results:
            done = result.status == "done"
            print(f"{result.scene}: {result.folder / 'contact_sheet.png' if done else result.outcome}")
    return 0 if not not_run and all(result.status == "done" for result in results) else 1
