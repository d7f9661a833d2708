"""The data sets and the layouts in which copies of them are found, in the order in which they are tried."""

from __future__ import annotations

from ihbench.scene.layout_choice import LayoutChoice

ZJU_MOCAP = LayoutChoice(
    "zju_mocap",
    (
        "ihbench.datasets.zju_mocap.original:ZjuMocap",
        "ihbench.datasets.zju_mocap.refine:ZjuRefine",
        "ihbench.datasets.zju_mocap.humannerf:HumanNerfFormat",
    ),
)
PEOPLE_SNAPSHOT = LayoutChoice(
    "people_snapshot",
    (
        "ihbench.datasets.people_snapshot.original:PeopleSnapshotRaw",
        "ihbench.datasets.people_snapshot.instantavatar:InstantAvatarFolder",
        "ihbench.datasets.people_snapshot.gaussianavatar:GaussianAvatarFolder",
    ),
)
OCMOTION = LayoutChoice(
    "ocmotion",
    (
        "ihbench.datasets.ocmotion.wild2avatar:OcMotionW2a",
        "ihbench.datasets.ocmotion.original:OcMotionOriginal",
    ),
)
PLAIN = LayoutChoice("custom", ("ihbench.datasets.plain.plain_scene:PlainScene",))
