"""The body mesh in one grey, a little brighter with every seed."""

import json
from dataclasses import dataclass

import numpy as np

from ihbench.render.zbuffer import rasterize


class Mannequin:
    def __init__(self, config):
        self.config = config

    def fit(self, training, *, device, seed, ledger, progress):
        trouble = self.config.trouble if seed == self.config.trouble_seed else "none"
        if trouble == "raise":
            raise RuntimeError("a leg fell off\nand rolled away")
        avatar = MannequinAvatar(training.body, self.config.brightness + 0.01 * seed, trouble)
        ledger.offer(1, avatar, force=True)
        return avatar

    def load(self, folder, body, device="cpu"):
        return MannequinAvatar(body, json.loads((folder / "grey.json").read_text()))


@dataclass(frozen=True)
class MannequinAvatar:
    body: object
    grey: float
    trouble: str = "none"

    def render(self, camera, body_pose, background=(1.0, 1.0, 1.0)):
        if self.trouble == "wrong-size":
            camera = camera.scaled(camera.width // 2, camera.height // 2)
        image = np.empty((camera.height, camera.width, 3), np.float32)
        image[:] = background
        mesh = rasterize(camera.project(self.body.pose(body_pose)), self.body.faces, camera.height, camera.width).mask
        image[mesh] = np.nan if self.trouble == "nan" else self.grey
        return image, mesh.astype(np.float32)

    def save(self, folder):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "grey.json").write_text(json.dumps(self.grey))
