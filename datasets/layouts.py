"""The data sets and the layouts in which copies of them are found, in the order in which they are tried."""

from __future__ import annotations

from ihbench.scene.layout_choice import LayoutChoice

ZJU_MOCAP = LayoutChoice(
    "zju_mocap",
    (
        "ihbench.datasets.zju_mocap:ZjuMocap",
        "ihbench.datasets.zju_refine:ZjuRefine",
        "ihbench.datasets.humannerf:HumanNerfFormat",
    ),
)
PEOPLE_SNAPSHOT = LayoutChoice(
    "people_snapshot",
    (
        "ihbench.datasets.people_snapshot:PeopleSnapshotRaw",
        "ihbench.datasets.instantavatar:InstantAvatar",
        "ihbench.datasets.gaussianavatar:GaussianAvatar",
    ),
)
OCMOTION = LayoutChoice(
    "ocmotion",
    (
        "ihbench.datasets.ocmotion_w2a:OcMotionW2a",
        "ihbench.datasets.ocmotion:OcMotionOriginal",
    ),
)
