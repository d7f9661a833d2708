"""`ihbench paint --protocol P`: how well every painter fills a scene's hidden pixels, against the truth.

For scenes whose truth is known behind the occluder: stand-ins, and captures under a made-up occlusion.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from ihbench.commands.options.device import check_device
from ihbench.commands.options.printing import Report
from ihbench.commands.options.scene_choice import ProtocolChanges
from ihbench.config_fields import SEEDS, Within, refuse_repeated
from ihbench.diffusion.inpaint_config import COMPONENTS, SIMPLE, InpaintConfig
from ihbench.errors import BadInput

ROWS = (*SIMPLE, *COMPONENTS)


@dataclass(frozen=True, kw_only=True)
class PaintOptions(ProtocolChanges, Report):
    protocol: str = "people_snapshot_occ"
    """A registered protocol (`ihbench list protocols`), or the path of a protocol file of your own (.toml)."""
    scene: tuple[str, ...] = ()
    """Scenes; none means all that the protocol names. Stand-ins may be any standin-1, standin-2, …"""
    rows: tuple[str, ...] = ROWS
    """Painters to compare."""
    frames: Annotated[int, Within(1, 100_000)] = 20
    """Training frames painted, evenly spread; personalisation sees all."""
    dropped: Annotated[float, Within(0, 1)] = 0.0
    """Share of the visible person that a frame keeps from the painters, and all that other frames show: how much they
    know of who it is. They learn from whole frames; scored are the same pixels."""
    seed: Annotated[tuple[int, ...], SEEDS] = (0,)
    """Seeds; their scores are averaged per scene before anything else."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where diffusion runs."""
    profile: str = "quick"
    """quick or paper: the size of the images."""
    data: Path | None = None
    """Your copy of the data set; without it (and without IHBENCH_DATA) a stand-in."""
    body: Path | None = None
    """SMPL model file for real data (or IHBENCH_BODY)."""
    out: Path | None = None
    """Folder for `paint.json`, the table and a picture per scene."""
    inpaint: InpaintConfig = field(default_factory=lambda: InpaintConfig(heads=None))
    """How diffusion is personalised and sampled."""


def main(argv: list[str]) -> int:
    from ihbench.commands.options.parse import options

    chosen = options(PaintOptions, argv, "paint", "Compare painters on hidden pixels whose truth is known.")
    from ihbench import registry
    from ihbench.clock.progress import Progress
    from ihbench.document.document import write
    from ihbench.files.pictures import encoded
    from ihbench.methods.inpainthuman.studies.paint_table import paint_scene, summary, table
    from ihbench.record import outputs
    from ihbench.scene.data_source import locate
    from ihbench.scene.protocol import load_protocol

    check_device(chosen.device)
    for row in chosen.rows:
        if row not in ROWS:
            raise BadInput(f"--rows {row}: {registry.nearest(row, list(ROWS))}")
    if not chosen.seed:
        raise BadInput("--seed: expected one number or more")
    refuse_repeated(chosen.seed, "--seed")
    refuse_repeated(chosen.rows, "--rows")
    protocols = chosen.apply(load_protocol(chosen.protocol, chosen.profile))
    if len(protocols) > 1:
        raise BadInput("--occlusion.fraction: one severity at a time")
    progress, scenes, data = Progress(), {}, ""
    source = locate(protocols[0], chosen.data, chosen.scene)
    if chosen.out is not None:
        outputs.check(chosen.out, ["paint.json", "paint.md", *(f"{scene}.png" for scene in source.scenes)])
    for scene in source.scenes:
        capture, body = source.open(scene, chosen.body, progress)
        data = capture.standin or capture.variant
        scenes[scene], picture = paint_scene(
            capture, body, protocols[0], chosen.rows, chosen.frames, chosen.seed, chosen.inpaint, progress,
            chosen.device, chosen.dropped,
        )  # fmt: skip
        if chosen.out is not None:
            outputs.write_bytes(chosen.out / f"{scene}.png", encoded(picture, "PNG"))
            outputs.write_json(chosen.out / "paint.json", {"scenes": scenes, "summary": summary(scenes)})
    result = summary(scenes)
    blocks = table(result, f"{protocols[0].name}, {len(scenes)} scenes, {data}")
    if chosen.out is not None:
        outputs.write_text(chosen.out / "paint.md", write(blocks, "md"))
    chosen.show({"scenes": scenes, "summary": result}, blocks)
    return 0
