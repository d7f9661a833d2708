"""`ihbench run --protocol P`: the main job."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, make_dataclass
from typing import Annotated, Any, Literal

import tyro

from ihbench import registry
from ihbench.commands.device import check_device
from ihbench.commands.keep import check_keep
from ihbench.commands.parse import options
from ihbench.commands.scene_choice import SceneChoice
from ihbench.errors import BadInput


@dataclass(frozen=True, kw_only=True)
class RunOptions(SceneChoice):
    seed: tuple[int, ...] = (0,)
    """Seeds; each is a run of its own."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to fit."""
    keep: tuple[str, ...] = ()
    """Switches that the plan must not change for this scene; "all" keeps everything."""
    force: bool = False
    """Run again even if the same run is done."""


def main(argv: list[str]) -> int:
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
    registry.entry_point("method", method)
    profiles = registry.load("config", method).PROFILES
    if profile not in profiles:
        raise BadInput(f"method {method!r}: unknown profile {profile!r}: {registry.nearest(profile, list(profiles))}")
    config = profiles[profile]
    switches = Annotated[type(config), tyro.conf.arg(name="method")]
    return make_dataclass(
        "RunOptions", [("config", switches, field(default=config))], bases=(RunOptions,), frozen=True, kw_only=True
    )


def _run(chosen: Any) -> int:
    check_device(chosen.device)
    from dataclasses import replace

    from ihbench.data_source import locate
    from ihbench.progress import Progress
    from ihbench.protocol import load_protocol
    from ihbench.results import as_json
    from ihbench.run_loop import RunRequest, run_scene

    protocols = chosen.apply(load_protocol(chosen.protocol, chosen.profile))
    if chosen.keep and "all" not in chosen.keep:
        check_keep(chosen.keep, chosen.config)
    if not chosen.seed or min(chosen.seed) < 0:
        raise BadInput(f"--seed {' '.join(map(str, chosen.seed))}: expected one number or more, each 0 or above")
    progress = Progress()
    results = []
    for protocol in protocols:
        source = locate(protocol, chosen.data, chosen.scene)
        request = RunRequest(
            protocol, chosen.method, chosen.config, 0, chosen.device, chosen.runs, chosen.body, chosen.force,
            chosen.keep,
        )  # fmt: skip
        for scene in source.scenes:
            for seed in dict.fromkeys(chosen.seed):
                progress.say(f"{protocol.name} {scene}: {chosen.method}, {chosen.profile} profile, seed {seed}")
                results.append(run_scene(replace(request, seed=seed), source, scene, progress))
    text = registry.load("report", "md")(results)
    if chosen.json:
        print(json.dumps(as_json(results), allow_nan=False))
    else:
        print(text)
        for result in results:
            print(
                f"{result.scene}: {result.folder / 'contact_sheet.png' if result.status == 'done' else result.folder}"
            )
    return 0 if all(result.status == "done" for result in results) else 1
