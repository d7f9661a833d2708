"""`ihbench ablate --protocol P`: what each component of a method is worth, in decibels and in seconds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, make_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from ihbench import registry
from ihbench.clock.gpu_slots import card_slots, free_memory
from ihbench.commands.options.device import check_device
from ihbench.commands.options.keep import check_keep
from ihbench.commands.options.parse import options
from ihbench.commands.options.printing import Report
from ihbench.commands.options.scene_choice import SceneChoice
from ihbench.config_fields import SEEDS, Within, refuse_repeated
from ihbench.errors import BadInput
from ihbench.scene.method_spec import method_spec

if TYPE_CHECKING:
    from ihbench.clock.progress import Progress
    from ihbench.document.document import Block
    from ihbench.runner.ablation import AblationSuite
    from ihbench.runner.executor import Cell, CellOutcome
    from ihbench.scene.data_source import DataSource

BETWEEN = ":"  # values of one switch


@dataclass(frozen=True, kw_only=True)
class AblateOptions(SceneChoice, Report):
    ladder: str = ""
    """A ladder of the method, such as table2 (`--ladder list` shows them all); by default its first."""
    vary: tuple[str, ...] = ()
    """A grid instead of a suite: NAME=VALUE:VALUE:..., such as levels=64:64,128 inpaint.on=on:off."""
    set: tuple[str, ...] = ()
    """Switches for every variant, NAME=VALUE, such as steps=200."""
    keep: tuple[str, ...] = ()
    """Fields that the plan must not change (`ihbench plan` lists them), or all. Fields that the variants set are kept
    anyway: what is compared is what was asked for."""
    seed: Annotated[tuple[int, ...], SEEDS] = (0, 1, 2)
    """Seeds; their scores are averaged per scene before anything is compared."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to fit."""
    workers: Annotated[int | None, Within(0, 1024)] = None
    """Runs at a time, each in a process of its own; by default one per core, on a GPU as many as its
    memory has room for. 0 runs them in this process."""
    share: bool = True
    """Let variants that begin alike share what they begin with; its seconds count in each of them."""
    out: Path | None = None
    """Folder for the table (Markdown) and its numbers (JSON)."""


def main(argv: list[str]) -> int:
    from ihbench.clock.progress import Progress

    chosen = options(AblateOptions, argv, "ablate", "What each component of a method is worth.")
    if chosen.ladder == "list":
        for name, suite in _suites(chosen.method).items():
            print(f"{name:<12}{len(suite.variants)} rungs: {suite.title}")
        return 0
    config = profile_of(chosen)
    vary = {
        name: [_value(chosen, config, name, text) for text in texts.split(BETWEEN)]
        for name, texts in _named(chosen.vary, "--vary").items()
    }
    switches = {name: _value(chosen, config, name, text) for name, text in _named(chosen.set, "--set").items()}
    blocks, numbers, outcomes = ablated(chosen, vary, switches, Progress())
    chosen.show(numbers, blocks)
    write_out(chosen, blocks, numbers)
    return 0 if all(outcome.done for outcome in outcomes) else 1


def ablated(
    chosen: AblateOptions, vary: Mapping[str, Sequence[Any]], switches: Mapping[str, Any], progress: Progress
) -> tuple[list[Block], Mapping[str, object], list[CellOutcome]]:
    """Do the runs of a suite, or of the grid `vary`, with `switches` on every variant: the table and its
    numbers, and how each run ended. The options' own words for both are not read. Raises `BadInput`."""
    from ihbench.clock.machine import usable_cores
    from ihbench.record import outputs
    from ihbench.runner.executor import run_cells

    if not chosen.seed:
        raise BadInput("--seed: expected one number or more")
    refuse_repeated(chosen.seed, "--seed")
    registry.entry_point("table", "ablation")  # before anything is fitted: another package may claim the name
    check_device(chosen.device)
    if chosen.out is not None:
        outputs.check(chosen.out, ["ablation.md", "ablation.json"])
    suite = _suite(chosen, vary, switches)
    cells = _cells(chosen, suite, progress)
    cores, cards = usable_cores(), None
    workers = cores if chosen.workers is None else chosen.workers
    if chosen.device == "cuda" and workers:
        cards = card_slots(free_memory(), len(cells), cores, chosen.workers)
        workers = len(cards)
    threads = max(cores // max(min(workers, len(cells)), 1), 1)
    outcomes = run_cells([cell for _, cell in cells], workers, threads, progress, cards)
    variants = [variant for variant, _ in cells]
    blocks, numbers = registry.load("table", "ablation")(suite, list(zip(variants, outcomes, strict=True)))
    return blocks, numbers, outcomes


def write_out(chosen: AblateOptions, blocks: Sequence[Block], numbers: Mapping[str, object]) -> None:
    """Write the table into the folder that was asked for, if one was."""
    from ihbench.document.document import write
    from ihbench.record import outputs

    if chosen.out is not None:
        outputs.write_text(chosen.out / "ablation.md", write(blocks, "md"))
        outputs.write_json(chosen.out / "ablation.json", numbers)


def profile_of(chosen: AblateOptions) -> Any:
    """The method's configuration under the profile. Raises `BadInput`."""
    from ihbench.runner.run_loop import configuration

    return configuration(chosen.method, chosen.profile, {})


def _suites(method: str) -> dict[str, AblationSuite]:
    from ihbench.runner.ablation import AblationSuite

    spec = method_spec(method)
    return spec.load(spec.ablations, Mapping, AblationSuite) if spec.ablations else {}


def _suite(chosen: AblateOptions, vary: Mapping[str, Sequence[Any]], switches: Mapping[str, Any]) -> AblationSuite:
    from ihbench.runner.ablation import grid, set_on_all

    config = profile_of(chosen)
    if vary:
        if chosen.ladder:
            raise BadInput(f"--ladder {chosen.ladder} with --vary: expected one of the two")
        suite = grid(config, vary)
    else:
        known = _suites(chosen.method)
        if not known:
            raise BadInput(
                f"method {chosen.method!r} registers no ladder; name switches with --vary NAME=VALUE:VALUE"
            )
        name = chosen.ladder or next(iter(known))
        if name not in known:
            raise BadInput(f"--ladder {name}: {registry.nearest(name, list(known))}")
        suite = known[name]
    for name in switches:
        if name in vary:
            raise BadInput(f"--set {name}={switches[name]}: --vary gives it its values; leave one of the two out")
    return set_on_all(suite, switches)


def _named(words: Sequence[str], flag: str) -> dict[str, str]:
    """Name -> text of several NAME=TEXT. Raises `BadInput` for another form, and for a name given twice."""
    pairs = [word.partition("=") for word in words]
    for word, (name, _, text) in zip(words, pairs, strict=True):
        if not name or not text:
            raise BadInput(f"{flag} {word}: expected NAME=VALUE")
    names = [name.removeprefix("method.").replace("-", "_") for name, _, _ in pairs]
    refuse_repeated(names, flag)
    return dict(zip(names, (text for _, _, text in pairs), strict=True))


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
    words = text.split(",")
    if len(words) > 1 and not isinstance(known[name], tuple):
        raise BadInput(f"{name}={text}: expected one value; --vary {name}={BETWEEN.join(words)} is several")
    return flat(options(Switches, [flag, *words], "ablate", "").config)[name]


def _cells(chosen: AblateOptions, suite: AblationSuite, progress: Any) -> list[tuple[str, Cell]]:
    """Variant and cell of every run: seeds outermost, so that an early table holds every variant."""
    from ihbench.runner.ablation import configured, kept, shared_part
    from ihbench.runner.executor import Cell
    from ihbench.runner.run_loop import RunRequest
    from ihbench.scene.data_source import locate
    from ihbench.scene.protocol import load_protocol

    config = profile_of(chosen)
    check_keep(chosen.keep, config)
    shared = method_spec(chosen.method).shared_states if chosen.share else {}
    cells: list[tuple[str, Cell]] = []
    sources: list[DataSource] = []
    for protocol in chosen.apply(load_protocol(chosen.protocol, chosen.profile)):
        source = locate(protocol, chosen.data, chosen.scene)
        sources.append(source)
        for seed in chosen.seed:
            for scene in source.scenes:
                first: dict[Any, int] = {}
                for variant in suite.variants:
                    own = configured(variant, config)
                    keep = tuple(dict.fromkeys((*chosen.keep, *kept(suite, variant, config))))
                    request = RunRequest(
                        protocol, chosen.method, own, seed, chosen.device, chosen.runs, chosen.body,
                        keep=keep, share=bool(shared),
                    )  # fmt: skip
                    after = None
                    for free in shared.values():
                        pinned = tuple(name for name in keep if not name.startswith(tuple(free)))
                        after = first.setdefault((shared_part(own, free), pinned), len(cells))
                    name = f"{protocol.name} {scene} seed {seed}, {variant.name}"
                    waits = after if after != len(cells) else None
                    cells.append((variant.name, Cell(name, request, source, scene, waits)))
    for source in sources:  # only now that every value is known to be good
        _open_all(source, chosen.body, progress)
    return cells


def _open_all(source: DataSource, body: Path | None, progress: Progress) -> None:
    """Make stand-ins once, before many want them. Raises `BadInput` where no scene can be opened; of others a line is
    enough, since their cells say so again."""
    refused = []
    for scene in source.scenes:
        try:
            source.open(scene, body, progress)
        except BadInput as error:
            refused.append((scene, error))
    if len(refused) == len(source.scenes):
        raise refused[0][1]
    for scene, error in refused:
        progress.say(f"{scene}: {error}")
