"""What a copy of a data set is good for: which protocols find their images in it, and pictures of how poses fit."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ihbench import registry
from ihbench.errors import BadInput
from ihbench.files.pictures import encoded
from ihbench.record import outputs
from ihbench.scene.contracts import Capture
from ihbench.scene.copy_report import CopyReport
from ihbench.scene.protocol import Protocol, load_protocol

if TYPE_CHECKING:
    from ihbench.body import Body
    from ihbench.body.pose import BodyPose
    from ihbench.camera import Camera

OVERLAYS = Path("data_check")
OVERLAY_HEIGHT = 480  # px
OVERLAY_FRAMES = 3
BODY_LINE, MASK_LINE = (0, 220, 255), (255, 60, 60)  # RGB: the projected body, the mask


def fitness(capture: Capture, protocol: Protocol) -> str:
    """ "complete", or what a protocol lacks of a capture, in one line."""
    n_frames, n_cameras = capture.n_frames, len(capture.camera_ids)
    training = protocol.training_frames(capture.name, n_frames)
    tested = protocol.test_views(capture.name, n_frames, n_cameras)
    views = {(protocol.train.camera, frame) for frame in training} | {(c, f) for c, f, _ in tested}
    last = max((frame for _, frame in views), default=-1)
    if not training:
        return f"no training frame among its {n_frames}"
    if not tested:
        return f"no test view: it has {n_cameras} camera{'s' * (n_cameras != 1)}"
    if last >= n_frames:
        return f"has {n_frames} frames, needs frame {last}"
    missing = sum(capture.lacks(camera, frame, protocol.subjects.silhouette) for camera, frame in views)
    return f"{missing} of {len(views)} views missing" if missing else "complete"


def overlay(capture: Capture, body: Body, source: str) -> NDArray[np.uint8] | None:
    """[H, W, 3] frames of the capture with the projected body's outline and the mask's; None where none is readable.

    Beginning, middle and end of what the first camera has. `source` names the masks.
    """
    frames = [frame for frame in range(capture.n_frames) if not capture.lacks(0, frame, source)]
    sampled = sorted({frames[int(k)] for k in np.linspace(0, len(frames) - 1, OVERLAY_FRAMES)}) if frames else []
    panels = []
    for frame in sampled:
        try:
            image, mask = capture.image(0, frame), capture.silhouette(0, frame, source)
            panels.append(_outlined(image, mask, body, capture.body_pose(frame), capture.camera(0)))
        except BadInput:
            continue  # the check has named it
    return np.concatenate(panels, axis=1) if panels else None


def _outlined(
    image: NDArray[np.uint8], mask: NDArray[np.bool_], body: Body, body_pose: BodyPose, camera: Camera
) -> NDArray[np.uint8]:
    import cv2

    from ihbench.render.zbuffer import rasterize

    height = min(OVERLAY_HEIGHT, image.shape[0])
    width = max(1, round(image.shape[1] * height / image.shape[0]))
    view = camera.scaled(width, height)
    drawn = rasterize(view.project(body.pose(body_pose)), body.faces, height, width).mask
    out = np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    small = cv2.resize(mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
    for region, colour in ((small, MASK_LINE), (drawn.astype(np.uint8), BODY_LINE)):
        out[(cv2.dilate(region, np.ones((3, 3), np.uint8)) != region)] = colour
    return out


def add_fitness(report: CopyReport, root: Path, body: Body | None, named: Path | None) -> None:
    """Extend the report of a check: per subject which protocols it serves, and the path of its overlay.

    `named` is the folder for overlays, None for the usual one.
    """
    no_place = ""
    overlays = OVERLAYS if named is None else named
    try:
        inside = overlays.resolve().is_relative_to(root.resolve())
    except FileNotFoundError:
        inside, no_place = False, "none: the current folder is gone; name one with --overlays"
    if inside:
        if named is not None:
            raise BadInput(f"--overlays {named}: lies in the data folder, which is never written to; name another")
        no_place = "none: the current folder is in the data folder, never written to; name one with --overlays"
    protocols = [load_protocol(name, "paper") for name in registry.names("protocol")]  # at what reads most
    protocols = [protocol for protocol in protocols if protocol.dataset == report.dataset]
    source = registry.load("dataset", report.dataset)(root)
    for subject in report.subjects:
        try:
            capture = source.open(subject.subject)
            subject.protocols = {protocol.name: fitness(capture, protocol) for protocol in protocols}
            if no_place:
                subject.overlay = no_place
                continue
            if capture.body == "smpl" and body is None:
                subject.overlay = "none: needs the SMPL model file, name it with --body or IHBENCH_BODY"
                continue
            if capture.body == "smpl":
                capture = source.open(subject.subject, body=body)
            picture = overlay(capture, capture.model, protocols[0].subjects.silhouette if protocols else "mask")
        except BadInput as error:
            if not subject.problems:
                subject.problem(str(error))
            continue
        if picture is None:
            subject.overlay = "none: no frame has image, mask and pose"
            continue
        path = overlays / f"{subject.subject}.png"
        try:
            outputs.write_bytes(path, encoded(picture, "PNG", compress_level=1), durable=False)
            subject.overlay = str(path)
        except (BadInput, OSError) as error:  # the check is worth having without a picture
            subject.overlay = no_place = f"none: {error}; name another folder with --overlays"
