"""`ihbench ablate --protocol P`: what each component of a method is worth, in decibels and in seconds."""

from __future__ import annotations

import json
from dataclasses import dataclass, make_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from ihbench import registry
from ihbench.bounds import Within
from ihbench.commands.device import check_device
from ihbench.commands.keep import check_keep
from ihbench.commands.parse import options
from ihbench.commands.scene_choice import SceneChoice
from ihbench.errors import BadInput

if TYPE_CHECKING:
    from ihbench.ablation import Ladder
    from ihbench.cells import Cell

BETWEEN = ":"  # values of one switch


@dataclass(frozen=True, kw_only=True)
class AblateOptions(SceneChoice):
    ladder: str = ""
    """A ladder of the method, such as table2 (`--ladder list` shows them all); by default its first."""
    vary: tuple[str, ...] = ()
    """A grid instead of a ladder: NAME=VALUE:VALUE:..., such as levels=64:64,128 inpaint.on=on:off."""
    set: tuple[str, ...] = ()
    """Switches for every rung, NAME=VALUE, such as steps=200."""
    keep: tuple[str, ...] = ()
    """Fields that the plan must not change (`ihbench plan` lists them), or all. Fields that the rungs set are kept
    anyway: what is compared is what was asked for."""
    seed: tuple[int, ...] = (0, 1, 2)
    """Seeds; their scores are averaged per scene before anything is compared."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to fit."""
    workers: Annotated[int | None, Within(0, 1024)] = None
    """Runs at a time, each in a process of its own; by default one per core. 0 runs them in this process."""
    share: bool = True
    """Let rungs that begin alike share what they begin with; its seconds count in each of them."""
    out: Path | None = None
    """Folder for the table (Markdown) and its numbers (JSON)."""


def main(argv: list[str]) -> int:
    chosen = options(AblateOptions, argv, "ablate", "What each component of a method is worth.")
    return _ablate(chosen)


def _ablate(chosen: AblateOptions) -> int:
    from ihbench import outputs
    from ihbench.cells import run_cells
    from ihbench.machine import usable_cores
    from ihbench.progress import Progress

    if chosen.ladder == "list":
        for name, found in _ladders(chosen.method).items():
            print(f"{name:<12}{len(found.rungs)} rungs: {found.title}")
        return 0
    if not chosen.seed or min(chosen.seed) < 0:
        raise BadInput(f"--seed {' '.join(map(str, chosen.seed))}: expected one number or more, each 0 or above")
    check_device(chosen.device)
    if chosen.out is not None:
        outputs.check(chosen.out, ["ablation.md", "ablation.json"])
    progress = Progress()
    ladder = _ladder(chosen)
    cells = _cells(chosen, ladder, progress)
    workers = usable_cores() if chosen.workers is None else chosen.workers
    threads = max(usable_cores() // max(min(workers, len(cells)), 1), 1)
    outcomes = run_cells([cell for _, cell in cells], workers, threads, progress)
    rungs = [rung for rung, _ in cells]
    text, numbers = registry.load("table", "ablation")(ladder, list(zip(rungs, outcomes, strict=True)))
    print(json.dumps(numbers, allow_nan=False) if chosen.json else text)
    if chosen.out is not None:
        outputs.write_text(chosen.out / "ablation.md", text)
        outputs.write_json(chosen.out / "ablation.json", numbers)
    return 0 if all(outcome.done for outcome in outcomes) else 1


def _ladders(method: str) -> dict[str, Ladder]:
    registry.entry_point("method", method)
    return registry.load("ladder", method) if method in registry.names("ladder") else {}


def _ladder(chosen: AblateOptions) -> Ladder:
    from ihbench.ablation import grid, set_on_all
    from ihbench.run_loop import configuration

    config = configuration(chosen.method, chosen.profile, {})
    if chosen.vary:
        if chosen.ladder:
            raise BadInput(f"--ladder {chosen.ladder} with --vary: expected one of the two")
        vary: dict[str, list[Any]] = {}
        for word in chosen.vary:
            name, texts = _split(word, "--vary")
            vary[name] = [_value(chosen, config, name, text) for text in texts.split(BETWEEN)]
        ladder = grid(config, vary)
    else:
        known = _ladders(chosen.method)
        if not known:
            raise BadInput(
                f"method {chosen.method!r} registers no ladder; name switches with --vary NAME=VALUE:VALUE"
            )
        name = chosen.ladder or next(iter(known))
        if name not in known:
            raise BadInput(f"--ladder {name}: {registry.nearest(name, list(known))}")
        ladder = known[name]
    switches = {}
    for word in chosen.set:
        name, text = _split(word, "--set")
        switches[name] = _value(chosen, config, name, text)
    return set_on_all(ladder, switches)


def _split(word: str, flag: str) -> tuple[str, str]:
    name, equals, text = word.partition("=")
    if not equals or not name:
        raise BadInput(f"{flag} {word}: expected NAME=VALUE")
    return name.removeprefix("method.").replace("-", "_"), text


def _value(chosen: AblateOptions, config: Any, name: str, text: str) -> Any:
    """A switch's value from its words on the command line, checked as `ihbench run --method.*` checks it."""
    from ihbench.config_fields import flat

    known = flat(config)
    if name not in known:
        raise BadInput(f"{name}={text}: no such switch of {chosen.method}: {registry.nearest(name, list(known))}")
    flag = f"--method.{name.replace('_', '-')}"
    if isinstance(known[name], bool):
        words = {"on": True, "true": True, "yes": True, "off": False, "false": False, "no": False}
        if text.lower() not in words:
            raise BadInput(f"{name}={text}: expected on or off")
        return words[text.lower()]
    Switches = make_dataclass(
        "Switches", [("config", Annotated[type(config), tyro.conf.arg(name="method")], config)], frozen=True
    )
    return flat(options(Switches, [flag, *text.split(",")], "ablate", "").config)[name]


def _cells(chosen: AblateOptions, ladder: Ladder, progress: Any) -> list[tuple[str, Cell]]:
    """Rung and cell of every run: seeds outermost, so that an early table holds every rung."""
    from ihbench.ablation import configured, kept, shared_part
    from ihbench.cells import Cell
    from ihbench.data_source import locate
    from ihbench.protocol import load_protocol
    from ihbench.run_loop import RunRequest, configuration

    config = configuration(chosen.method, chosen.profile, {})
    if chosen.keep and "all" not in chosen.keep:
        check_keep(chosen.keep, config)
    shared = getattr(registry.load("config", chosen.method), "SHARED_STATES", {}) if chosen.share else {}
    cells: list[tuple[str, Cell]] = []
    for protocol in chosen.apply(load_protocol(chosen.protocol, chosen.profile)):
        source = locate(protocol, chosen.data, chosen.scene)
        for scene in source.scenes:
            try:
                source.open(scene, chosen.body, progress)  # makes a stand-in once, before many want it
            except BadInput as error:  # its cells will say so again; the other scenes go on
                progress.say(f"{scene}: {error}")
        for seed in dict.fromkeys(chosen.seed):
            for scene in source.scenes:
                first: dict[Any, int] = {}
                for rung in ladder.rungs:
                    own = configured(rung, config)
                    keep = tuple(dict.fromkeys((*chosen.keep, *kept(ladder, rung, config))))
                    request = RunRequest(
                        protocol, chosen.method, own, seed, chosen.device, chosen.runs, chosen.body,
                        keep=keep, share=bool(shared),
                    )  # fmt: skip
                    after = None
                    for free in shared.values():
                        pinned = tuple(name for name in keep if not name.startswith(tuple(free)))
                        after = first.setdefault((shared_part(own, free), pinned), len(cells))
                    name = f"{protocol.name} {scene} seed {seed}, {rung.name}"
                    waits = after if after != len(cells) else None
                    cells.append((rung.name, Cell(name, request, source, scene, waits)))
    return cells
