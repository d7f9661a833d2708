"""What a scene does not need of Gaussians in the big pose."""

from __future__ import annotations

from collections.abc import Sequence

from ihbench.fit.big_pose.config import BigPoseConfig
from ihbench.scene.plan import Omission, SceneMeasure

STATIC_DEG = 5.0  # below this no joint moves, and no network learns anything from the pose
ONE_SIDE_DEG = 10.0  # a person who turns by less is seen from one direction: colours by direction are one colour

# shares of a step's time, estimated
POSE_SHARE = 0.03
DIRECTION_SHARE = 0.01


def parts_of_no_use(config: BigPoseConfig, scene: SceneMeasure, stages: Sequence[str]) -> list[Omission]:
    """The pose network where nobody moves, colours by direction where the person is seen from one; `stages` are the
    ledger's paths of the fits."""
    out = []
    if config.pose_network and scene.motion_deg < STATIC_DEG:
        reason = f"no joint turns more than {scene.motion_deg:.1f}° over the training frames (limit {STATIC_DEG}°)"
        out.append(Omission("pose_network", False, reason, dict.fromkeys(stages, POSE_SHARE)))
    if config.highest_degree > 0 and max(scene.turn_deg, scene.motion_deg) < ONE_SIDE_DEG:
        reason = (
            f"the person turns by {scene.turn_deg:.1f}° and moves by {scene.motion_deg:.1f}°: every point is seen "
            "from one direction"
        )
        out.append(Omission("sh_degree", 0, reason, dict.fromkeys(stages, DIRECTION_SHARE)))
    return out
