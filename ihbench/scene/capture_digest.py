"""A hash of everything that a protocol reads of a capture: other data make another run."""

from __future__ import annotations

import hashlib

import numpy as np

from ihbench.scene.contracts import Capture
from ihbench.scene.protocol import Protocol


def capture_digest(capture: Capture, protocol: Protocol) -> str:
    """Hash of the cameras, body poses, images and masks that the protocol uses of a capture."""
    digest = hashlib.sha256()
    n_frames = capture.n_frames
    trained = [(protocol.train.camera, frame) for frame in protocol.training_frames(capture.name, n_frames)]
    n_cameras = len(capture.camera_ids)
    tested = [(camera, frame) for camera, frame, _ in protocol.test_views(capture.name, n_frames, n_cameras)]
    views = [(camera, frame) for camera, frame in trained + tested if frame < n_frames]
    for index in dict.fromkeys(camera for camera, _ in views):
        camera = capture.camera(index)
        distortion = np.zeros(5) if camera.distortion is None else camera.distortion
        for value in (camera.K, camera.R, camera.t, distortion, np.array([camera.width, camera.height])):
            digest.update(np.ascontiguousarray(value, np.float64).tobytes())
    for frame in sorted({frame for _, frame in views}):
        pose = capture.body_pose(frame)
        for value in (pose.pose, pose.betas, pose.transl):
            digest.update(np.ascontiguousarray(value).tobytes())
    for camera, frame in views:
        digest.update(capture.content_digest(camera, frame, protocol.subjects.silhouette))
    return digest.hexdigest()[:10]
