"""`ihbench export RUN --to ply`: a run's Gaussians in a pose, for viewers and editors."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from ihbench.commands.options.parse import options
from ihbench.config_fields import WHOLE, whole
from ihbench.errors import BadInput
from ihbench.version import __version__

if TYPE_CHECKING:
    from ihbench.record.finished_run import FinishedRun
    from ihbench.record.schema import RunRecord


@dataclass(frozen=True)
class ExportOptions:
    run: Annotated[Path, tyro.conf.Positional]
    """A run folder."""
    to: Literal["ply"] = "ply"
    """Format."""
    pose: str = "a_pose"
    """A named canonical pose, or the number of a frame of the run's capture, such as 120."""
    axes: Literal["viewer", "world"] = "viewer"
    """viewer: upright in splat viewers, the pelvis at the origin; world: the coordinates of the data set."""
    out: Path | None = None
    """File to write; by default `avatar.ply` in the run folder."""
    data: Path | None = None
    """Your copy of the data set, if the run used one and --pose is a frame number."""
    body: Path | None = None
    """SMPL model file, if the run used one."""


def main(argv: list[str]) -> int:
    chosen = options(ExportOptions, argv, "export", "An avatar's Gaussians as a standard splat PLY.")
    import numpy as np

    from ihbench.files.atomic import is_stream
    from ihbench.files.splat_ply import UPRIGHT, VIEWER_TURN, write_splat_ply
    from ihbench.record import outputs
    from ihbench.record.finished_run import FinishedRun
    from ihbench.runner.run_loop import load_avatar

    outputs.check_file(chosen.out, chosen.data, chosen.body)
    run = FinishedRun(chosen.run, chosen.data, chosen.body)
    avatar = load_avatar(run)
    if not hasattr(avatar, "gaussians"):
        raise BadInput(f"{chosen.run}: its method has no Gaussians to export")
    pose = _pose(chosen.pose, avatar, run)
    means, scales, colors = (values.detach().cpu().numpy() for values in avatar.gaussians(pose))
    finite = np.isfinite(np.column_stack([means, scales, colors])).all(1)
    if not finite.all():  # the renderer does not draw them either
        print(f"ihbench: {int((~finite).sum())} Gaussians that are not finite are left out", file=sys.stderr)
        means, scales, colors = means[finite], scales[finite], colors[finite]
    rotation = UPRIGHT
    if chosen.axes == "viewer":
        means, rotation = _for_viewers(means, pose, avatar, run), VIEWER_TURN
    out = chosen.out or chosen.run / "avatar.ply"
    write_splat_ply(out, means, scales, colors, _comments(chosen, run.record), rotation)
    said = sys.stderr if is_stream(out) else sys.stdout  # which may be the file itself
    print(f"{len(means)} Gaussians in pose {chosen.pose} written to {out}", file=said)
    return 0


def _pose(name: str, avatar: Any, run: FinishedRun) -> Any:
    import numpy as np

    from ihbench.body.canonical import canonical_pose
    from ihbench.body.pose import BodyPose

    if WHOLE.fullmatch(name):
        return run.capture.body_pose(whole(name))
    return BodyPose(canonical_pose(name), avatar.betas, np.zeros(3))


def _for_viewers(means: Any, pose: Any, avatar: Any, run: FinishedRun) -> Any:
    """[N, 3] m, upright about the pelvis of the avatar's own body."""
    from ihbench.body.pose import BodyPose
    from ihbench.body.skinning_numpy import axis_angle_to_matrix
    from ihbench.files.splat_ply import in_viewer_axes

    body = getattr(avatar, "body", None) or run.body
    pelvis = body.posed_joints(BodyPose(pose.pose, avatar.betas, pose.transl))[0]
    return in_viewer_axes(means, pelvis, axis_angle_to_matrix(pose.pose[0]))


def _comments(chosen: ExportOptions, record: RunRecord) -> list[str]:
    """What the file says of itself. Brush and splat-transform read the last."""
    identity = record.identity
    axes = {
        "viewer": "y down, z forward (180 degrees about z from y-up); the pelvis at the origin",
        "world": "those of the data set",
    }[chosen.axes]
    return [
        f"Exported from ihbench {__version__}",
        f"run: {record.digest} {identity.method} {identity.scene}",
        f"pose: {chosen.pose}",
        "units: metres",
        f"axes: {axes}",
        "SplatRenderMode: default",
    ]
