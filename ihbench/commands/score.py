"""`ihbench score --protocol P --predictions DIR`: score images that somebody else's code rendered."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ihbench import registry
from ihbench.commands.options.parse import options
from ihbench.commands.options.scene_choice import ProtocolChanges, RunsFolder
from ihbench.commands.report import headline
from ihbench.errors import BadInput

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ihbench.clock.progress import Progress
    from ihbench.data.prepared import Prepared
    from ihbench.record.results import RunResult
    from ihbench.scene.data_source import DataSource


@dataclass(frozen=True, kw_only=True)
class ScoreOptions(ProtocolChanges, RunsFolder):
    protocol: str | None = None
    """A registered protocol (`ihbench list protocols`), or the path of a protocol file of your own (.toml)."""
    prepared: Path | None = None
    """In its place: the folder that `ihbench prepare` has written. It says the protocol, its changes and the data."""
    predictions: Path
    """Folder of rendered images, one a test view, in the protocol's size and on its background (or transparent)."""
    pattern: str | None = None
    """How they are named, with {scene}, {camera}, {camera_index}, {frame}, {index}; numbers may be padded, as in
    {frame:06d}. By default {scene}/{camera}/{frame:06d}.png or {camera}/{frame:06d}.png, whichever finds more."""
    name: str | None = None
    """The row's name in tables; by default the folder's."""
    alpha: str | None = None
    """What colours beside an alpha channel are: straight, premultiplied (times alpha) or composited (on the
    background already). Needed only where they do not tell."""
    names: bool = False
    """Print the file expected for each test view and end."""
    scene: tuple[str, ...] = ()
    """Scenes; none means all that the protocol names and the folder has images of."""
    profile: str | None = None
    """quick or paper: which views, in which size. By default the one whose image size the predictions have."""
    force: bool = False
    """Score again even if the same images have been."""
    full: bool = False
    """Print the whole report in Markdown, and not the headline table alone."""


def main(argv: list[str]) -> int:
    chosen = options(ScoreOptions, argv, "score", "Score images that somebody else's code rendered.")
    from ihbench.clock.progress import Progress
    from ihbench.record.results import summary

    if chosen.names:
        return _print_names(chosen, _source(chosen)[0])
    results = scored(chosen, Progress())
    complete = all(not result.missing_views for result in results)
    if chosen.json:
        print(json.dumps(summary(results), allow_nan=False))
    else:
        print(registry.load("report", "md")(results) if chosen.full else headline(results), end="")
    return 0 if complete and all(result.status == "done" for result in results) else 1


def scored(chosen: ScoreOptions, progress: Progress) -> list[RunResult]:
    """Score what the options name: a result for each scene. Says what is missing or doubtful. Raises `BadInput`."""
    from ihbench.runner.score_predictions import ScoreRequest, score_scene
    from ihbench.scoring.calibration import ROWS

    source, prepared = _source(chosen)
    name = chosen.name or chosen.predictions.resolve().name
    if name in ROWS or not name.strip():
        raise BadInput(f"--name {name!r}: is a calibration row's name; choose another with --name")
    protocol = source.protocol
    body = chosen.body or (prepared.body_file if prepared is not None else None)
    request = ScoreRequest(
        protocol, chosen.predictions, name, chosen.pattern, chosen.runs, body, chosen.force, chosen.alpha, prepared
    )
    results = []
    for scene in chosen.scene or _with_folders(source.scenes, chosen.predictions, chosen.pattern):
        progress.say(f"{protocol.name} {scene}: predictions {name}, {protocol.profile} profile")
        results.append(score_scene(request, source, scene, progress))
    for result in results:
        files = result.about.predictions
        assert files is not None
        for kind, paths in (("missing", files.missing), ("surplus", files.surplus)):
            for path in paths:
                progress.say(f"{result.scene}: {kind}: {path}")
        for note in [*files.notes, *files.doubts]:
            progress.say(f"{result.scene}: {note}")
    return results


def _source(chosen: ScoreOptions) -> tuple[DataSource, Prepared | None]:
    """What is scored: under which protocol, on which data, and what was prepared of it."""
    from ihbench.data.prepared import read_prepared
    from ihbench.scene.data_source import locate
    from ihbench.scene.protocol import PROFILES, load_protocol

    if (chosen.protocol is None) == (chosen.prepared is None):
        raise BadInput("score: give either --protocol, or with --prepared the folder that `ihbench prepare` wrote")
    if chosen.prepared is not None:
        if chosen.profile is not None or chosen.changes():
            raise BadInput(
                f"--prepared {chosen.prepared}: says profile, size, frames and occlusion itself; leave those out"
            )
        prepared = read_prepared(chosen.prepared)
        return prepared.source(chosen.data, chosen.scene), prepared
    assert chosen.protocol is not None
    sources = {}
    for profile in (chosen.profile,) if chosen.profile else PROFILES:
        protocols = chosen.apply(load_protocol(chosen.protocol, profile))
        if len(protocols) > 1:
            raise BadInput("--occlusion.fraction: predictions were made under one severity; name that one")
        sources[profile] = locate(protocols[0], chosen.data, chosen.scene)
    return sources[_profile_of(chosen, sources)], None


def _profile_of(chosen: ScoreOptions, sources: Mapping[str, DataSource]) -> str:
    """The profile whose test views have the names and the size of images in the folder; the first where none has."""
    first = next(iter(sources))
    if len(sources) == 1 or not chosen.predictions.is_dir():
        return first
    from ihbench.scoring.predictions import size_of_most

    sides: dict[str, tuple[int, int]] = {}  # profile -> px of most of its images, and how many there are of its views
    views: dict[str, int] = {}
    for profile, source in sources.items():
        scenes = {scene: source.test_keys(scene) for scene in source.scenes}
        views[profile] = max(1, sum(map(len, scenes.values())))
        sides[profile] = size_of_most(chosen.predictions, scenes, chosen.pattern)
    fitting = [profile for profile, (side, _) in sides.items() if side == sources[profile].protocol.image.size]
    if fitting:  # of two in one size the one of which fewer views are missing
        return max(fitting, key=lambda profile: sides[profile][1] / views[profile])
    side, count = max(sides.values(), key=lambda found: found[1])
    if not count:
        return first
    sizes = {profile: source.protocol.image.size for profile, source in sources.items()}
    sizes_text = ", ".join(f"{size} px in {profile}" for profile, size in sizes.items())
    raise BadInput(
        f"predictions {chosen.predictions}: most are {side} px on their longer side; "
        f"{chosen.protocol} has {sizes_text}; "
        f"say otherwise with --image-size"
    )


def _with_folders(scenes: tuple[str, ...], root: Path, pattern: str | None) -> tuple[str, ...]:
    """The scenes that have a folder of their name among the predictions; all of them where none has."""
    if pattern is not None and "{scene}" not in pattern:
        if len(scenes) > 1:
            raise BadInput(
                f"--pattern {pattern!r}: does not tell the scenes apart; add {{scene}}, or name one with --scene"
            )
        return scenes
    present = tuple(scene for scene in scenes if (root / scene).is_dir())
    if not present and pattern is None and len(scenes) > 1:
        raise BadInput(
            f"predictions {root}: no folder of the name of a scene ({', '.join(scenes)}); "
            "name the scene of these images with --scene"
        )
    return present or scenes


def _print_names(chosen: ScoreOptions, source: DataSource) -> int:
    from ihbench.scoring.predictions import expected_names

    names = {scene: expected_names(chosen.pattern, scene, source.test_keys(scene)) for scene in source.scenes}
    if chosen.json:
        print(json.dumps(names))
    else:
        print("\n".join(name for some in names.values() for name in some))
    return 0
