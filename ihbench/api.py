"""The commands as functions: `ihbench.run`, `load_scene`, `ablate`, `score` and `frame`, checked as in a terminal.

What is given is held against the types and bounds of the commands' options, after numpy's numbers have
become Python's and lists tuples. Whatever does not fit is one `BadInput`, before anything is read or written.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import numpy as np

from ihbench import registry
from ihbench.clock.progress import Progress
from ihbench.commands.options.device import check_device
from ihbench.commands.options.keep import check_keep
from ihbench.commands.options.scene_choice import NO_CHOICE, OcclusionChoice, ProtocolChanges
from ihbench.config_fields import SEEDS, check, replaced, shown
from ihbench.errors import BadInput
from ihbench.files.paths import user_path
from ihbench.record.frame import frame as frame
from ihbench.record.results import RunResult
from ihbench.scene.protocol import CHOICES, Protocol, load_protocol

if TYPE_CHECKING:
    from ihbench.body import Body
    from ihbench.scene.views import OccludedScene

Choices = Mapping[str, Any] | None  # of the protocol, by name: {"image.edge": "soft"}
Options = TypeVar("Options", bound=ProtocolChanges)
Occlusion = str | Mapping[str, Any] | None  # a rule's name, or rule, fraction, covers as on the command line


@dataclass(frozen=True, kw_only=True)
class _SceneArguments(ProtocolChanges):
    """One scene, and with defaults what only `run` takes."""

    protocol: str
    scene: str
    profile: str
    data: Path | None
    body: Path | None
    method: str = ""
    runs: Path = Path()
    seed: Annotated[int, SEEDS] = 0
    device: Literal["cpu", "cuda"] = "cpu"
    force: bool = False
    keep: tuple[str, ...] = ()

    def changed_protocol(self) -> Protocol:
        return self.apply(load_protocol(self.protocol, self.profile))[0]


def run(
    protocol: str | Path = "zju_occ",
    scene: str = "standin-1",
    *,
    method: str = "inpainthuman",
    profile: str = "quick",
    data: Path | str | None = None,
    runs: Path | str = "runs",
    body: Path | str | None = None,
    seed: int = 0,
    device: str = "cpu",
    force: bool = False,
    keep: Sequence[str] = (),
    image_size: int | None = None,
    train_frames: str | None = None,
    test_frames: str | None = None,
    occlusion: Occlusion = None,
    choices: Choices = None,
    progress: Progress | None = None,
    **switches: Any,
) -> RunResult:
    """Run one method on one scene with one seed, as `ihbench run` does; `switches` are fields of the method's
    configuration (`**{"inpaint.on": False}` for those of a part).

    `train_frames` and `test_frames` are "START:STOP:STEP"; `occlusion` is a rule's name, or a mapping with any of
    "rule", "fraction" and "covers"; `choices` has any other choice of the protocol. Raises `BadInput` for anything
    the caller got wrong. Divergence and failure are statuses of the result.
    """
    arguments = locals()
    for name, value in (("scene", scene), ("seed", seed)):
        if isinstance(value, list | tuple | set | range | np.ndarray) and np.ndim(list(value)):
            raise BadInput(f"{name} {shown(value)}: expected one; call ihbench.run for each, or ihbench.ablate")
    options, progress = _checked(_SceneArguments, arguments)
    from ihbench.runner.run_loop import RunRequest, configuration, run_scene
    from ihbench.scene.data_source import locate

    check_device(options.device)
    changed = options.changed_protocol()
    config = configuration(options.method, changed.profile, {name: _plain(v) for name, v in switches.items()})
    check_keep(options.keep, config)
    request = RunRequest(
        changed, options.method, config, options.seed, options.device, options.runs, options.body, options.force,
        options.keep,
    )  # fmt: skip
    return run_scene(request, locate(changed, options.data, (options.scene,)), options.scene, progress)


def load_scene(
    protocol: str | Path = "zju_occ",
    scene: str = "standin-1",
    *,
    profile: str = "quick",
    data: Path | str | None = None,
    body: Path | str | None = None,
    image_size: int | None = None,
    train_frames: str | None = None,
    test_frames: str | None = None,
    occlusion: Occlusion = None,
    choices: Choices = None,
    progress: Progress | None = None,
) -> tuple[OccludedScene, Body]:
    """Training and test views of one scene under a protocol, loaded lazily, and the body model of its poses.

    Frames and occlusion as in `run`. Raises `BadInput` for anything the caller got wrong.
    """
    options, progress = _checked(_SceneArguments, locals())
    from ihbench.scene.data_source import locate
    from ihbench.scene.views import open_scene

    changed = options.changed_protocol()
    source = locate(changed, options.data, (options.scene,))
    capture, model = source.open(options.scene, options.body, progress)
    return open_scene(capture, changed), model


@dataclass(frozen=True)
class Ablation:
    """What `ablate` found: the table as Markdown and as numbers, and the runs that were done."""

    text: str
    numbers: Mapping[str, object]
    results: list[RunResult]
    problems: list[str]  # of runs that are not done


def ablate(
    protocol: str | Path = "zju_occ",
    scene: str | Sequence[str] = (),
    *,
    method: str = "inpainthuman",
    ladder: str = "",
    vary: Mapping[str, Sequence[Any]] | None = None,
    switches: Mapping[str, Any] | None = None,
    keep: Sequence[str] = (),
    seed: int | Sequence[int] = (0, 1, 2),
    profile: str = "quick",
    data: Path | str | None = None,
    runs: Path | str = "runs",
    body: Path | str | None = None,
    device: str = "cpu",
    workers: int | None = None,
    share: bool = True,
    out: Path | str | None = None,
    image_size: int | None = None,
    train_frames: str | None = None,
    test_frames: str | None = None,
    occlusion: Occlusion = None,
    choices: Choices = None,
    progress: Progress | None = None,
) -> Ablation:
    """What each component of a method is worth, as `ihbench ablate` does: a registered ladder, or a grid `vary` of
    switch -> values. `switches` are set on every rung (`--set`). No scene means all that the protocol names.

    In a script that starts workers, call it under `if __name__ == "__main__":`; `workers=0` starts none. Raises
    `BadInput` for anything the caller got wrong.
    """
    arguments = locals() | {"scene": _several(scene), "seed": _several(seed), "vary": ()}
    from ihbench.commands.ablate import AblateOptions, ablated, write_out
    from ihbench.document.document import write

    grids = {} if vary is None else vary
    for name, value in (("vary", grids), ("switches", switches or {})):
        if not isinstance(value, Mapping):
            raise BadInput(f"{name} {shown(value)}: expected a mapping from switches to values")
    values = {name: _several(value) for name, value in grids.items()}
    options, progress = _checked(AblateOptions, arguments)
    fixed = {name: _plain(value) for name, value in (switches or {}).items()}
    blocks, numbers, outcomes = ablated(options, values, fixed, progress)
    write_out(options, blocks, numbers)
    return Ablation(
        write(blocks, "md"),
        numbers,
        [outcome.result for outcome in outcomes if outcome.result is not None],
        [f"{o.cell.name}: {o.problem or (o.result and o.result.outcome)}" for o in outcomes if not o.done],
    )


def score(
    predictions: Path | str,
    protocol: str | Path | None = None,
    scene: str | Sequence[str] = (),
    *,
    prepared: Path | str | None = None,
    name: str | None = None,
    pattern: str | None = None,
    alpha: str | None = None,
    profile: str | None = None,
    data: Path | str | None = None,
    runs: Path | str = "runs",
    body: Path | str | None = None,
    force: bool = False,
    image_size: int | None = None,
    train_frames: str | None = None,
    test_frames: str | None = None,
    occlusion: Occlusion = None,
    choices: Choices = None,
    progress: Progress | None = None,
) -> list[RunResult]:
    """Score a folder of images that somebody else's code rendered, as `ihbench score` does: a result for each scene.

    What is missing or doubtful stands in `result.about.predictions`, and `progress` says it. Raises
    `BadInput` for anything the caller got wrong.
    """
    from ihbench.commands.score import ScoreOptions, scored

    return scored(*_checked(ScoreOptions, locals() | {"scene": _several(scene)}))


def _checked(kind: type[Options], arguments: Mapping[str, Any]) -> tuple[Options, Progress]:
    """A function's arguments as options, and its progress. Raises `BadInput` under the argument's own name."""
    progress = arguments["progress"]
    if progress is not None and not isinstance(progress, Progress):
        raise BadInput(f"progress {shown(progress)}: expected an ihbench.clock.progress.Progress, or None")
    special = {"occlusion": _occlusion, "choices": _choices}
    values: dict[str, Any] = {}
    for name, hint in ((f.name, str(f.type)) for f in fields(kind) if f.name in arguments):
        value = special.get(name, _plain)(arguments[name])
        if isinstance(value, str | os.PathLike):
            value = user_path(value, name) if "Path" in hint else os.fspath(value)
        values[name] = value
    options = kind(**values)
    check(options, "")
    return options, progress or Progress()


def _occlusion(value: Occlusion) -> OcclusionChoice:
    given = {"rule": value} if isinstance(value, str) else {} if value is None else value
    if not isinstance(given, Mapping):
        raise BadInput(f"occlusion {shown(value)}: expected a rule's name, or a mapping of rule, fraction, covers")
    known = [f.name for f in fields(OcclusionChoice)]
    for name in given:
        if name not in known:
            raise BadInput(f"occlusion {name!r}: {registry.nearest(str(name), known)}")
    plain = {name: _plain(part) for name, part in given.items()}
    fraction = plain.get("fraction")
    if isinstance(fraction, tuple):
        raise BadInput(f"occlusion.fraction {shown(fraction)}: expected one number; call once for each")
    return OcclusionChoice(plain.get("rule"), () if fraction is None else (fraction,), plain.get("covers"))


def _choices(value: Choices) -> Any:
    given = {} if value is None else value
    if not isinstance(given, Mapping):
        raise BadInput(f"choices {shown(value)}: expected a mapping from a protocol's choices to their values")
    for name in given:
        if name not in CHOICES:
            raise BadInput(f"choices {name!r}: {registry.nearest(str(name), list(CHOICES))}")
    return replaced(NO_CHOICE, {name: _plain(part) for name, part in given.items()})


def _several(value: Any) -> Any:
    """A value on its own as a tuple of it."""
    plain = _plain(value)
    return plain if isinstance(plain, tuple) else (plain,)


def _plain(value: Any) -> Any:
    """numpy's and torch's numbers as Python's, lists and arrays as tuples; anything else as it is."""
    if isinstance(value, str | bytes | os.PathLike):
        return value
    if hasattr(value, "tolist"):
        value = value.tolist()
    return tuple(_plain(item) for item in value) if isinstance(value, list | tuple | range) else value
