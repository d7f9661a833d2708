"""Your own method, without a package: fit it on what a protocol shows, let the protocol score what it draws.

    python 02_own_method.py [PROTOCOL]

`own_method.md` beside this makes a package of one, which `ihbench run --method` then knows.
"""

import sys
from pathlib import Path

import numpy as np

import ihbench
from ihbench.files.images import write_png
from ihbench.metrics.eight_bit import displayed
from ihbench.render.zbuffer import rasterize
from ihbench.scene.contracts import MaskState

PROTOCOL = sys.argv[1] if len(sys.argv) > 1 else "zju_occ"


class MeanColour:
    """Everybody is the body mesh in the mean colour of the person's visible pixels."""

    def fit(self, training):
        pixels = [view.image[view.mask == MaskState.PERSON] for view in training.views]
        self.body, self.colour = training.body, np.concatenate(pixels).mean(0) / 255
        return self

    def render(self, camera, body_pose, background):
        mesh = rasterize(camera.project(self.body.pose(body_pose)), self.body.faces, camera.height, camera.width)
        return np.where(mesh.mask[..., None], self.colour, background)


scene, body = ihbench.load_scene(PROTOCOL, "standin-1")
avatar = MeanColour().fit(scene.training)  # hidden pixels are MaskState.UNKNOWN: nobody is told what is there
folder = Path("drawn")
for key, view in zip(scene.test_keys, scene.test, strict=True):
    image = avatar.render(view.camera, view.body_pose, scene.protocol.image.background)
    write_png(folder / f"{key.name}.png", displayed(image))

(result,) = ihbench.score(folder, PROTOCOL, "standin-1", name="mean-colour")
for row, means in result.rows.items():
    shown = [f"{i.display.title} {i.display.text(m.value)}" for i, m in means.items() if i.region == result.headline]
    print(f"{row:18}", ", ".join(shown))
