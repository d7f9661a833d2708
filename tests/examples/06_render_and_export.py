"""A finished run to look at and to take elsewhere: a turntable, a motion, a mesh that moves, splats.

    python 06_render_and_export.py RUN_FOLDER

The same as commands: ihbench render RUN --orbit 24 --out turntable.webp, and so on.
"""

import sys

from ihbench.cli import main

RUN = sys.argv[1]

for words in (
    ["render", RUN, "--orbit", "12", "--size", "96", "--out", "turntable.webp"],
    ["render", RUN, "--motion", "march", "--fps", "6", "--size", "96", "--out", "march.gif"],
    ["export", RUN, "--to", "ply", "--out", "avatar.ply"],  # SuperSplat, three.js, Blender 5.3
    ["export", RUN, "--to", "glb", "--motion", "march", "--fps", "6", "--out", "avatar.glb"],  # Blender, Unity, …
    ["export", RUN, "--to", "amass", "--motion", "march", "--fps", "6", "--out", "march.npz"],
):
    if status := main(words):
        sys.exit(status)
