"""Your own video: images, masks, a camera and SMPL poses become a scene folder, which is checked and occluded.

    python 04_own_video.py

Here a grey person is drawn in place of your frames; `datasets/plain/plain_scene.md` has the same for what ROMP,
4D-Humans, WHAM, GVHMR and EasyMocap write.
"""

from pathlib import Path

import numpy as np

import ihbench
from ihbench.body import load_body, write_body
from ihbench.body.pose import BodyPose
from ihbench.camera import Camera, look_at
from ihbench.cli import main
from ihbench.datasets.plain import plain_scene
from ihbench.render.zbuffer import rasterize

folder, body = Path("dance"), load_body()
R, t = look_at(np.array([0.0, 0.1, 2.6]), np.array([0.0, -0.2, 0.0]))
camera = Camera(np.array([[110.0, 0, 48], [0, 110, 48], [0, 0, 1]]), R, t, 96, 96)  # your K; R = 1, t = 0 will do

poses = []
for frame in range(10):
    pose = np.zeros((24, 3))
    pose[0, 1] = 0.3 * frame  # the person turns; radians, axis-angle, root first
    pose[16, 2], pose[17, 2] = -1.0, 1.0
    poses.append(BodyPose(pose, np.zeros(10), np.zeros(3)))
    mesh = rasterize(camera.project(body.pose(poses[-1])), body.faces, camera.height, camera.width).mask
    image = np.where(mesh[..., None], np.uint8([150, 120, 90]), np.uint8([255, 255, 255]))
    plain_scene.write_frame(folder, frame, image, mesh)
plain_scene.write_cameras(folder, {"phone": camera})
plain_scene.write_poses(folder, poses)
write_body(folder / "body.npz", body)  # with SMPL poses leave it out, and name your SMPL file with --body

assert main(["data", "check", str(folder)]) == 0  # mirrored? other units? outlines are drawn into data_check/
scene, _ = ihbench.load_scene("custom_occ", "dance", data=folder, image_size=64)
print(f"{len(scene.train)} training and {len(scene.test)} test views; hidden: {scene.hiding.hidden_share():.0%}")
print(f"ihbench run --protocol custom_occ --data {folder}    # fits and scores it")
