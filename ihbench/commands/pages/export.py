"""`ihbench export RUN --to ...`: a run's avatar as a file for other people's viewers, editors and engines."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from ihbench.commands.options.parse import options
from ihbench.config_fields import Entries, Within
from ihbench.errors import BadInput

if TYPE_CHECKING:
    from ihbench.export.files import Exporter
    from ihbench.show.motion import Motion

ABOUT = "The avatar of a run as a splat PLY, a glTF, a texture or a motion, for other programs."
NAMES = {  # of what is written into the run folder
    "ply": "avatar.ply",
    "ply-sequence": "avatar_ply",
    "glb": "avatar.glb",
    "glb-splats": "avatar_splats.glb",
    "texture": "avatar_texture.png",
    "amass": "avatar_motion.npz",
}
Y_UP = ("glb", "glb-splats")  # as glTF says
CLIPS = ("march",)  # of a glTF, unless others are named
MOST_FRAMES = 5_000


@dataclass(frozen=True)
class ExportOptions:
    run: Annotated[Path, tyro.conf.Positional]
    """A run folder."""
    to: Literal["ply", "ply-sequence", "glb", "glb-splats", "texture", "amass"] = "ply"
    """ply: splats, in one pose; ply-sequence: a folder of them, a frame each; glb: a skinned mesh with a baked
    texture and clips, of any method; glb-splats: glTF with KHR_gaussian_splatting; texture: the mesh's, as a PNG;
    amass: a motion as an .npz."""
    pose: str = "a_pose"
    """A named canonical pose, or the number of a frame of the run's capture, such as 120."""
    motion: Annotated[tuple[str, ...], Entries(0, 32)] = ()
    """march, lunge, bow, squat, kick, punch, twist, wave or turn; an .npz of AMASS or a poses.npz; or capture, the
    training frames. One, or for glb several: its clips (march by default)."""
    fps: Annotated[float, Within(0.5, 240)] = 25.0
    """Frames per second of a motion."""
    axes: Literal["splat", "y-up", "world"] | None = None
    """splat: upright in splat viewers, which take y for down; y-up: glTF's; both with the pelvis at the origin;
    world: the data set's coordinates. By default splat for PLY; glTF is y-up, AMASS z-up, or the world's."""
    relief: bool = True
    """Of a glb: the avatar's surface where its method tells it, over the body's own."""
    footprint: Annotated[float | None, Within(0, 0.1)] = None
    """m that Gaussians are widened by, as a standard deviation: they were fitted under the blur of a pixel of the
    training images, and show gaps without it. By default that blur, if the data are at hand; 0 for none."""
    texture_size: Annotated[int, Within(64, 4096)] = 512
    """Texels a side of a texture that is baked from pictures of the avatar."""
    out: Path | None = None
    """File to write (of ply-sequence a folder); by default in the run folder: avatar.ply, avatar.glb, …"""
    data: Path | None = None
    """Your copy of the data set, if the run used one and --pose is a frame number."""
    body: Path | None = None
    """SMPL model file, if the run used one."""


def main(argv: list[str]) -> int:
    chosen = options(ExportOptions, argv, "export", ABOUT)
    axes = _axes(chosen)
    if len(chosen.motion) > 1 and chosen.to != "glb":
        raise BadInput(f"--motion: expected one for --to {chosen.to}; several are the clips of a glb")
    if not chosen.motion and chosen.to in ("ply-sequence", "amass"):
        raise BadInput(f"--to {chosen.to}: needs a --motion, such as march, an .npz, or capture")
    from ihbench.clock.progress import Progress
    from ihbench.export.about import licence
    from ihbench.export.files import Exporter
    from ihbench.files.atomic import is_stream
    from ihbench.record import outputs
    from ihbench.record.finished_run import FinishedRun
    from ihbench.show.subject import Subject

    outputs.check_file(chosen.out, chosen.data, chosen.body)
    subject = Subject(FinishedRun(chosen.run, chosen.data, chosen.body))
    maker = Exporter(subject, Progress(), chosen.relief, chosen.texture_size, chosen.footprint)
    out = chosen.out or chosen.run / NAMES[chosen.to]
    if chosen.to.startswith(("ply", "glb-splats")) and chosen.footprint is None and subject.pixel is None:
        print(f"ihbench: {subject.no_pixel}", file=sys.stderr)
    what = _write(chosen, axes, maker, out)
    said = sys.stderr if is_stream(out) else sys.stdout  # which may be the file itself
    print(f"{what} written to {out}", file=said)
    if subject.body.name == "smpl" and chosen.to in ("glb",):
        print(f"ihbench: {out}: {licence(subject.body, holds_body=True)}", file=sys.stderr)
    return 0


def _axes(chosen: ExportOptions) -> str:
    if chosen.to in Y_UP:
        if chosen.axes not in (None, "y-up"):
            raise BadInput(f"--axes {chosen.axes}: --to {chosen.to} is y-up, as glTF says")
        return "y-up"
    if chosen.to == "amass" and chosen.axes in ("splat", "y-up"):
        raise BadInput(f"--axes {chosen.axes}: AMASS is z-up; expected world, or leave it out")
    return chosen.axes or "splat"


def _write(chosen: ExportOptions, axes: str, maker: Exporter, out: Path) -> str:
    """Write the file, or the files; what was written, in words."""
    from ihbench.files import atomic

    if chosen.to == "ply-sequence":
        return _write_sequence(chosen, axes, maker, out)
    if chosen.to == "ply":
        data = maker.ply(maker.subject.pose(chosen.pose), axes, chosen.pose)
        what = f"{_count(data)} Gaussians in pose {chosen.pose}"
    elif chosen.to == "glb-splats":
        data = maker.splat_glb(maker.subject.pose(chosen.pose), chosen.pose)
        what = f"the Gaussians in pose {chosen.pose}, {len(data) / 1e6:.1f} MB,"
    elif chosen.to == "glb":
        clips = [(_named(name), _motion(maker, name, chosen.fps)) for name in chosen.motion or CLIPS]
        data = maker.skinned_glb(chosen.pose, clips)
        words = ", ".join(f"{name} ({motion.seconds:.1f} s)" for name, motion in clips)
        what = f"a skinned mesh with the clips {words}, {len(data) / 1e6:.1f} MB,"
    elif chosen.to == "texture":
        data, what = maker.texture(), "the texture"
    else:
        motion = _motion(maker, chosen.motion[0], chosen.fps)
        data = maker.amass(motion, _named(chosen.motion[0]), chosen.axes or "")
        what = f"{len(motion)} frames of {_named(chosen.motion[0])}"
    atomic.write_bytes(out, data)
    return what


def _write_sequence(chosen: ExportOptions, axes: str, maker: Exporter, out: Path) -> str:
    from ihbench.record import outputs

    motion = _motion(maker, chosen.motion[0], chosen.fps)
    if out.exists() and not out.is_dir():
        raise BadInput(f"--out {out}: is a file; a sequence needs a folder")
    last = f"avatar_{len(motion):04d}.ply"
    longer = sorted(path.name for path in out.glob("avatar_????.ply") if path.name > last)
    if longer:
        raise BadInput(f"{out}: holds {longer[0]} of a longer sequence; name another folder")
    outputs.check(out, [f"avatar_{k:04d}.ply" for k in range(1, len(motion) + 1)])
    for name, data in maker.ply_sequence(motion, axes, _named(chosen.motion[0])):
        outputs.write_bytes(out / name, data, durable=False)
    return f"{len(motion)} frames of {_named(chosen.motion[0])}"


def _motion(maker: Exporter, name: str, fps: float) -> Motion:
    motion: Any = maker.subject.motion(name, fps)
    if len(motion) > MOST_FRAMES:
        raise BadInput(f"--motion {name}: {len(motion)} frames: expected at most {MOST_FRAMES}; choose a lower --fps")
    return motion


def _named(motion: str) -> str:
    return Path(motion).stem if motion.endswith(".npz") else motion


def _count(ply: bytes) -> int:
    line = next(line for line in ply[:4096].split(b"\n") if line.startswith(b"element vertex"))
    return int(line.split()[-1])
