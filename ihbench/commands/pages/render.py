"""`ihbench render RUN...`: avatars of finished runs turned around, moved, filmed from anywhere, beside each other."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from ihbench.commands.options.device import check_device
from ihbench.commands.options.parse import options
from ihbench.config_fields import IMAGE_SIZES, Entries, Within
from ihbench.errors import BadInput

if TYPE_CHECKING:
    from ihbench.clock.progress import Progress
    from ihbench.show.rendering import Film

ABOUT = "The avatar of a run, of any method, as a picture that moves."
NAME = "render.webp"  # in the run folder, without --out
TOGETHER = "side_by_side.webp"  # here, of several runs
MOST_FRAMES = 10_000


@dataclass(frozen=True)
class RenderOptions:
    run: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Run folders."""
    orbit: Annotated[int | None, Within(1, MOST_FRAMES)] = None
    """Frames of one turn of the camera around the body; 60 unless --camera or --motion is given."""
    camera: str | None = None
    """front, left, back or right of the body; a camera of the data set, for its test views; or a path.json as
    nerfbaselines' viewer saves it, in the world of the pose that is shown."""
    pose: str | None = None
    """A canonical pose, such as a_pose or t_pose (upright, the pelvis at the origin, y up), or the number of a frame
    of the run's capture."""
    motion: str | None = None
    """march, lunge, bow, squat, kick, punch, twist, wave or turn; an .npz of AMASS or a poses.npz; or capture, the
    training frames."""
    side_by_side: bool = False
    """Several runs beside each other under their names, and before them the truth where a camera of the data set has
    it."""
    captions: bool = True
    """The names of panels above them."""
    size: Annotated[tuple[Annotated[int, Within(*IMAGE_SIZES)], ...], Entries(0, 2)] = ()
    """px: a side, or width and height (default 512). Of data sets' cameras and paths the longer side (default: their
    own)."""
    sharp: bool = False
    """Draw finer than the training images, too. Methods that learn points then show gaps between them; without it,
    what is drawn larger is enlarged."""
    fps: Annotated[float | None, Within(0.5, 240)] = None
    """Frames per second; a path's own, else 25."""
    elevation: Annotated[float, Within(-80, 80)] = 8.0
    """Degrees from which --orbit and the sides look down."""
    background: Annotated[tuple[Annotated[float, Within(0, 1)], ...], Entries(0, 3)] = ()
    """Red, green, blue, 0 to 1; by default the protocol's."""
    out: Path | None = None
    """.webp, .gif, .webm or .mp4, or a folder for PNG frames; by default render.webp in the run folder, and
    ./side_by_side.webp."""
    save_path: Path | None = None
    """Also write the cameras, as a path that --camera reads."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where avatars are drawn."""
    data: Path | None = None
    """Your copy of the data set, if the runs used one and its cameras, frames or shape are wanted."""
    body: Path | None = None
    """SMPL model file, if the runs used one."""


def main(argv: list[str]) -> int:
    chosen = options(RenderOptions, argv, "render", ABOUT)
    _check(chosen)
    from ihbench.clock.progress import Progress
    from ihbench.record import outputs
    from ihbench.record.finished_run import FinishedRun
    from ihbench.show.rendering import film
    from ihbench.show.shots import View
    from ihbench.show.subject import Subject

    for path in (chosen.out, chosen.save_path):
        outputs.check_file(path, chosen.data, chosen.body)
    subjects = [Subject(FinishedRun(run, chosen.data, chosen.body), chosen.device) for run in chosen.run]
    view = View(
        chosen.orbit, chosen.camera, chosen.pose, chosen.motion, chosen.size, chosen.fps, chosen.elevation
    )  # fmt: skip
    r_g_b = None if not chosen.background else (chosen.background[0], chosen.background[1], chosen.background[2])
    groups = [subjects] if chosen.side_by_side else [[subject] for subject in subjects]
    progress = Progress()
    for group in groups:
        made = film(group, view, r_g_b, chosen.side_by_side, chosen.captions, chosen.sharp)
        if len(made) > MOST_FRAMES:
            raise BadInput(f"{len(made)} frames: expected at most {MOST_FRAMES}; choose a lower --fps")
        for subject in group if not chosen.sharp else ():
            if subject.pixel is None:
                progress.say(f"ihbench: {subject.no_pixel}")
        _write(made, chosen, _target(chosen, group[0].run.folder), progress)
    return 0


def _check(chosen: RenderOptions) -> None:
    """Everything that can be refused before anything heavy is imported."""
    from ihbench.show.movie import check_target

    if not chosen.run:
        raise BadInput("render: expected a run folder or more; see ihbench render --help")
    if len(chosen.run) > 1 and not chosen.side_by_side and chosen.out is not None:
        raise BadInput(f"--out {chosen.out}: is one place for {len(chosen.run)} runs; add --side-by-side")
    if len(chosen.background) not in (0, 3):
        raise BadInput("--background: expected three numbers, red, green and blue, 0 to 1")
    check_device(chosen.device)
    if chosen.out is not None:
        check_target(chosen.out)


def _target(chosen: RenderOptions, folder: Path) -> Path:
    if chosen.out is not None:
        return chosen.out
    return Path(TOGETHER) if chosen.side_by_side and len(chosen.run) > 1 else folder / NAME


def _write(made: Film, chosen: RenderOptions, out: Path, progress: Progress) -> None:
    from ihbench.files import atomic
    from ihbench.files.pictures import encoded as encoded_picture
    from ihbench.record import outputs
    from ihbench.show.movie import check_target, encoded
    from ihbench.show.trajectory import trajectory_json

    suffix = check_target(out)
    beside_others = chosen.out is None and out == Path(TOGETHER)
    if suffix == "":
        names = [f"{k:06d}.png" for k in range(len(made))]
        outputs.check(out, names)
        _refuse_other_frames(out, len(made))
        for name, frame in zip(names, made.frames(progress), strict=True):
            outputs.write_bytes(out / name, encoded_picture(frame, "PNG", compress_level=3), durable=False)
    else:
        if beside_others:
            outputs.check(out.parent, [out.name])
        data = encoded(made.frames(progress), suffix, made.fps)
        (outputs if beside_others else atomic).write_bytes(out, data)
    if chosen.save_path is not None:
        cameras = [shot.camera.undistorted() for shot in made.takes[0].shots]
        atomic.write_text(chosen.save_path, trajectory_json(cameras, made.fps))
    said = sys.stderr if atomic.is_stream(out) else sys.stdout
    print(f"{len(made)} frames at {made.fps:g} a second written to {out}", file=said)


def _refuse_other_frames(folder: Path, count: int) -> None:
    """Frames of a longer film would pass for the end of this one."""
    others = sorted(p.name for p in folder.glob("??????.png") if p.stem.isdecimal() and int(p.stem) >= count)
    if others:
        raise BadInput(f"{folder}: holds {others[0]} of a longer film; name another folder")
