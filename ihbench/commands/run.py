"""`ihbench run --protocol P`: the main job."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, make_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from ihbench import registry
from ihbench.commands.options.device import check_device
from ihbench.commands.options.keep import check_keep
from ihbench.commands.options.parse import options
from ihbench.commands.options.scene_choice import RunsFolder, SceneChoice
from ihbench.commands.report import headline
from ihbench.config_fields import SEEDS, refuse_repeated
from ihbench.errors import BadInput
from ihbench.scene.method_spec import method_spec

if TYPE_CHECKING:
    from ihbench.record.results import RunResult


@dataclass(frozen=True, kw_only=True)
class Fitting:
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to fit."""
    force: bool = False
    """Run again even if the same run is done."""
    full: bool = False
    """Print the whole report in Markdown, and not the headline table alone."""


@dataclass(frozen=True, kw_only=True)
class RunOptions(SceneChoice, Fitting):
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
    if _peek(argv, "--like", ""):
        return _repeat(options(LikeOptions, argv, "run", "Repeat a run from its record."))
    method, profile = _peek(argv, "--method", "inpainthuman"), _peek(argv, "--profile", "quick")
    chosen = options(_with_switches(method, profile), argv, "run", "Fit a method under a protocol and score it.")
    return _run(chosen)


def _peek(argv: list[str], flag: str, default: str) -> str:
    """The value of a flag that decides which other flags exist."""
    for k, word in enumerate(argv):
        if word == flag and k + 1 < len(argv):
            return argv[k + 1]
        if word.startswith(flag + "="):
            return word.partition("=")[2]
    return default


def _with_switches(method: str, profile: str) -> type[RunOptions]:
    """`RunOptions` plus the method's own configuration as `--method.*` flags."""
    config = method_spec(method).profile(profile)
    switches = Annotated[type(config), tyro.conf.arg(name="method")]
    return make_dataclass(
        "RunOptions", [("config", switches, field(default=config))], bases=(RunOptions,), frozen=True, kw_only=True
    )


def _run(chosen: Any) -> int:
    check_device(chosen.device)
    registry.entry_point("report", "md")  # before anything is fitted: another package may claim the name
    from dataclasses import replace

    from ihbench.clock.progress import Progress
    from ihbench.runner.run_loop import RunRequest, run_scene
    from ihbench.scene.data_source import locate
    from ihbench.scene.protocol import load_protocol

    protocols = chosen.apply(load_protocol(chosen.protocol, chosen.profile))
    check_keep(chosen.keep, chosen.config)
    if not chosen.seed:
        raise BadInput("--seed: expected one number or more")
    refuse_repeated(chosen.seed, "--seed")
    progress = Progress()
    results = []
    for protocol in protocols:
        source = locate(protocol, chosen.data, chosen.scene)
        request = RunRequest(
            protocol, chosen.method, chosen.config, 0, chosen.device, chosen.runs, chosen.body, chosen.force,
            chosen.keep,
        )  # fmt: skip
        for scene in source.scenes:
            for seed in chosen.seed:
                progress.say(f"{protocol.name} {scene}: {chosen.method}, {chosen.profile} profile, seed {seed}")
                results.append(run_scene(replace(request, seed=seed), source, scene, progress))
    return _print(results, chosen)


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


def _print(results: list[RunResult], chosen: Any) -> int:
    from ihbench.record.results import summary

    if chosen.json:
        print(json.dumps(summary(results), allow_nan=False))
    elif not chosen.full:
        print(headline(results), end="")
    else:
        print(registry.load("report", "md")(results))
        for result in results:
            done = result.status == "done"
            print(f"{result.scene}: {result.folder / 'contact_sheet.png' if done else result.outcome}")
    return 0 if all(result.status == "done" for result in results) else 1
