"""`ihbench prepare --protocol P --out DIR`: hand out the occluded training set for other people's code."""

from __future__ import annotations

import json
import shlex
from dataclasses import dataclass
from pathlib import Path

from ihbench.commands.options.parse import options
from ihbench.commands.options.scene_choice import OwnFiles, ProtocolChanges
from ihbench.errors import BadInput

OWN_LAYOUT = {
    "zju_mocap": "zju",
    "people_snapshot": "instantavatar",
    "ocmotion": "ocmotion-w2a",
    "custom": "humannerf",
}


@dataclass(frozen=True, kw_only=True)
class PrepareOptions(ProtocolChanges, OwnFiles):
    protocol: str
    """A registered protocol (`ihbench list protocols`), or the path of a protocol file of your own (.toml)."""
    out: Path
    """Folder to write into; each scene gets a folder of its own."""
    layout: str | None = None
    """zju, zju-refine, humannerf, instantavatar, gaussianavatar or ocmotion-w2a; by default the data set's own."""
    scene: tuple[str, ...] = ()
    """Scenes; none means all that the protocol names."""
    profile: str = "paper"
    """paper or quick: the size of the images, and which test views."""
    force: bool = False
    """Replace what an earlier call has written. A folder that holds anything else is left alone."""


def main(argv: list[str]) -> int:
    chosen = options(PrepareOptions, argv, "prepare", "Write the occluded training set, and nothing that it hides.")
    from ihbench import registry
    from ihbench.clock.progress import Progress
    from ihbench.data.prepare import check_target, prepare
    from ihbench.scene.data_source import locate, own_body
    from ihbench.scene.protocol import load_protocol
    from ihbench.scene.views import open_scene

    protocols = chosen.apply(load_protocol(chosen.protocol, chosen.profile))
    if len(protocols) > 1:
        raise BadInput("--occlusion.fraction: one severity at a time, each into a folder of its own")
    layout = chosen.layout or OWN_LAYOUT.get(protocols[0].dataset, "humannerf")
    registry.entry_point("training layout", layout)
    source, progress = locate(protocols[0], chosen.data, chosen.scene), Progress()
    sources = [path for path in (source.root, own_body(chosen.body)) if path is not None]
    sources += [path for path in source.root.glob("*") if path.is_symlink()]  # subjects that lie elsewhere
    for scene in source.scenes:
        check_target(chosen.out, scene, chosen.force, sources)  # all of them before the first is written
    written = {}
    for scene in source.scenes:
        capture, body = source.open(scene, chosen.body, progress)
        opened = open_scene(capture, protocols[0])
        own = (None, None) if source.is_standin else (source.root, own_body(chosen.body))
        written[scene] = str(prepare(opened, body, chosen.out, layout, progress, chosen.force, sources, *own))
    score = f"ihbench score --prepared {shlex.quote(str(chosen.out))} --predictions DIR"
    if chosen.json:
        print(json.dumps({"layout": layout, "protocol": protocols[0].name, "scenes": written, "score": score}))
    else:
        for scene, folder in written.items():
            print(f"{scene}: {folder} ({layout}); the test views to draw are in {folder}/test_views.json")
        print(f"score what your code draws: {score}")
    return 0
