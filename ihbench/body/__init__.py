"""The SMPL-shaped body: model, files, skinning, texture coordinates, canonical poses. Needs numpy only.

The differentiable torch functions are in `ihbench.body.skinning`, which is imported on its own.
"""

from ihbench.body.canonical import CANONICAL_POSES, canonical_pose
from ihbench.body.model import Body
from ihbench.body.root_convention import from_zju_root, zju_root
from ihbench.body.skeleton import JOINT_INDEX, JOINT_NAMES, PARENTS, PART_PALETTE
from ihbench.body.smpl_file import load_body, write_body
from ihbench.body.uv import Texels, chart_padding, position_map, sample_uv, texel_table

__all__ = [
    "CANONICAL_POSES",
    "JOINT_INDEX",
    "JOINT_NAMES",
    "PARENTS",
    "PART_PALETTE",
    "Body",
    "Texels",
    "canonical_pose",
    "chart_padding",
    "from_zju_root",
    "load_body",
    "position_map",
    "sample_uv",
    "texel_table",
    "write_body",
    "zju_root",
]
