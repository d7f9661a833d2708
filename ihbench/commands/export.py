"""`ihbench export RUN --to ply`: a run's Gaussians in a pose, for viewers and editors."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from ihbench.bounds import WHOLE, whole
from ihbench.commands.parse import options
from ihbench.errors import BadInput


@dataclass(frozen=True)
class ExportOptions:
    run: Annotated[Path, tyro.conf.Positional]
    """A run folder."""
    to: Literal["ply"] = "ply"
    """Format."""
    pose: str = "a_pose"
    """A named canonical pose, or the number of a frame of the run's capture, such as 120."""
    out: Path | None = None
    """File to write; by default `avatar.ply` in the run folder."""
    data: Path | None = None
    """Your copy of the data set, if the run used one and --pose is a frame number."""
    body: Path | None = None
    """SMPL model file, if the run used one."""


def main(argv: list[str]) -> int:
    chosen = options(ExportOptions, argv, "export", "An avatar's Gaussians as a standard splat PLY.")
    from ihbench import outputs
    from ihbench.atomic import is_stream
    from ihbench.run_loop import load_avatar
    from ihbench.splat_ply import write_splat_ply

    outputs.check_file(chosen.out)
    avatar, open_capture = load_avatar(chosen.run, chosen.data, chosen.body)
    if not hasattr(avatar, "gaussians"):
        raise BadInput(f"{chosen.run}: its method has no Gaussians to export")
    means, scales, colors = avatar.gaussians(_pose(chosen.pose, avatar, open_capture))
    out = chosen.out or chosen.run / "avatar.ply"
    write_splat_ply(out, means.cpu().numpy(), scales.cpu().numpy(), colors.cpu().numpy())
    said = sys.stderr if is_stream(out) else sys.stdout  # which may be the file itself
    print(f"{len(means)} Gaussians in pose {chosen.pose} written to {out}", file=said)
    return 0


def _pose(name: str, avatar: Any, open_capture: Any) -> Any:
    import numpy as np

    from ihbench.body.canonical import canonical_pose
    from ihbench.scene import BodyPose

    if WHOLE.fullmatch(name):
        return open_capture().body_pose(whole(name))
    return BodyPose(canonical_pose(name), avatar.betas, np.zeros(3))
