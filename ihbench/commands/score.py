"""`ihbench score --protocol P --predictions DIR`: score images that somebody else's code rendered."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ihbench import registry
from ihbench.commands.parse import options
from ihbench.commands.scene_choice import ProtocolChanges
from ihbench.errors import BadInput

if TYPE_CHECKING:
    from ihbench.data_source import DataSource


@dataclass(frozen=True, kw_only=True)
class ScoreOptions(ProtocolChanges):
    protocol: str
    """A registered protocol (`ihbench list protocols`), or the path of a protocol file of your own (.toml)."""
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
    data: Path | None = None
    """Your copy of the data set; without it (and without IHBENCH_DATA) a stand-in."""
    body: Path | None = None
    """SMPL model file for real data (or IHBENCH_BODY)."""
    runs: Path = Path("runs")
    """Where run folders lie."""
    force: bool = False
    """Score again even if the same images have been."""
    json: bool = False
    """Print one JSON object on stdout and nothing else there."""


def main(argv: list[str]) -> int:
    chosen = options(ScoreOptions, argv, "score", "Score images that somebody else's code rendered.")
    from ihbench.calibration import ROWS
    from ihbench.data_source import locate
    from ihbench.progress import Progress
    from ihbench.protocol import load_protocol
    from ihbench.results import as_json
    from ihbench.score_predictions import ScoreRequest, score_scene

    protocols = chosen.apply(
        load_protocol(chosen.protocol, chosen.profile or _profile_of(chosen.predictions, chosen.protocol))
    )
    if len(protocols) > 1:
        raise BadInput("--occlusion.fraction: predictions were made under one severity; name that one")
    protocol = protocols[0]
    source = locate(protocol, chosen.data, chosen.scene)
    if chosen.names:
        return _print_names(chosen, source)
    name = chosen.name or chosen.predictions.resolve().name
    if name in ROWS or not name.strip():
        raise BadInput(f"--name {name!r}: is a calibration row's name; choose another with --name")
    progress = Progress()
    request = ScoreRequest(
        protocol, chosen.predictions, name, chosen.pattern, chosen.runs, chosen.body, chosen.force, chosen.alpha
    )
    results = []
    for scene in chosen.scene or _with_folders(source.scenes, chosen.predictions, chosen.pattern):
        progress.say(f"{protocol.name} {scene}: predictions {name}, {protocol.profile} profile")
        results.append(score_scene(request, source, scene, progress))
    complete = True
    for result in results:
        found = result.record["about"]["predictions"]
        complete &= not found["missing"]
        for kind in ("missing", "surplus"):
            for path in found[kind]:
                progress.say(f"{result.scene}: {kind}: {path}")
        for note in [*found["notes"], *found["doubts"]]:
            progress.say(f"{result.scene}: {note}")
    if chosen.json:
        told = as_json(results)
        for run, result in zip(told["runs"], results, strict=True):
            run["predictions"] = result.record["about"]["predictions"]
        print(json.dumps(told, allow_nan=False))
    else:
        print(registry.load("report", "md")(results))
    return 0 if complete and all(result.status == "done" for result in results) else 1


def _profile_of(root: Path, protocol: str) -> str:
    """The profile whose test views have the size of the first image in the folder; paper where there is none."""
    from ihbench.predictions import image_files, read_image
    from ihbench.protocol import PROFILES, load_protocol

    if not root.is_dir():
        return PROFILES[0]
    for path in image_files(root):
        side = max(read_image(path, (1.0, 1.0, 1.0)).shape[:2])
        sizes = {name: load_protocol(protocol, name).image.size for name in PROFILES}
        for name, size in sizes.items():
            if size == side:
                return name
        told = ", ".join(f"{size} px in {name}" for name, size in sizes.items())
        raise BadInput(f"prediction {path}: is {side} px on its longer side; {protocol} has {told}")
    return PROFILES[0]


def _with_folders(scenes: tuple[str, ...], root: Path, pattern: str | None) -> tuple[str, ...]:
    """The scenes that have a folder of their name among the predictions; all of them where none has."""
    if pattern is not None and "{scene}" not in pattern:
        if len(scenes) > 1:
            raise BadInput(
                f"--pattern {pattern!r}: does not tell the scenes apart; add {{scene}}, or name one with --scene"
            )
        return scenes
    found = tuple(scene for scene in scenes if (root / scene).is_dir())
    if not found and pattern is None and len(scenes) > 1:
        raise BadInput(
            f"predictions {root}: no folder of the name of a scene ({', '.join(scenes)}); "
            "name the scene of these images with --scene"
        )
    return found or scenes


def _print_names(chosen: ScoreOptions, source: DataSource) -> int:
    from ihbench.predictions import expected_names
    from ihbench.progress import Progress
    from ihbench.views import open_scene

    told = {}
    for scene in source.scenes:
        capture, _ = source.open(scene, chosen.body, Progress())
        told[scene] = expected_names(chosen.pattern, scene, open_scene(capture, source.protocol).test_keys)
    if chosen.json:
        print(json.dumps(told))
    else:
        print("\n".join(name for names in told.values() for name in names))
    return 0
