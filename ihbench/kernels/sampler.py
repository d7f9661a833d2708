"""Work-precision of the sampler, for `ihbench kernels`: how far few DDIM steps of `mini` are from many, and how long
they take."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from torch import Tensor

from ihbench import registry
from ihbench.body import load_body
from ihbench.diffusion.backbone import Backbone
from ihbench.diffusion.crops.crop_view import CropView, cut_view
from ihbench.diffusion.crops.diffusion_batch import DiffusionBatch, batch_of, shared_noise
from ihbench.diffusion.inpaint_config import InpaintConfig
from ihbench.diffusion.mini.weights import load_mini
from ihbench.diffusion.sampling import sample
from ihbench.diffusion.subject_token import ANYBODY
from ihbench.kernels.measuring import Row, interleave, peak_mib, row_of, timed
from ihbench.scene.contracts import MaskState, TrainView

STEPS = (1, 2, 3, 6, 12)
MANY = 50  # steps, in float64: what few steps are held against
SEED = 0


def sampler_rows(
    repeats: int, steps: Sequence[int] = STEPS, many: int = MANY, given: Backbone | None = None
) -> list[Row]:
    """One crop of a procedural person whose middle half is hidden, painted from no noise (the default of `mini`) and
    from full noise. Value error: root mean square over the hidden pixels, peak 1, against `many` steps in float64.

    `repeats` above 3 are 3.
    """
    backbone = load_mini() if given is None else given
    view = hidden_middle(backbone.size)
    batch = batch_of([view], backbone.device)
    hidden = batch.unknown.expand(-1, 3, -1, -1) > 0.5
    own = InpaintConfig().settled().noise
    rows = []
    for scale in dict.fromkeys((own, 1.0)):
        noise = scale * shared_noise(backbone, SEED, view.crop.width)
        exact = _exact(backbone, batch, noise, many)
        paint = {f"{n} steps": partial(_paint, backbone, batch, noise, n) for n in steps}
        timings = interleave({name: partial(timed, f) for name, f in paint.items()}, min(repeats, 3), warm_up=1)
        for name, samples in timings.items():
            memory = peak_mib(paint[name])
            off = (paint[name]().double() - exact)[hidden] / 2  # [-1, 1] has twice the range
            error = float(off.square().mean().sqrt())
            case = f"mini, noise × {scale:g}, {view.crop.width}×{view.crop.height} px"
            rows.append(row_of("sampler", case, name, samples, memory, error, knob="steps"))
    return rows


def hidden_middle(size: int) -> CropView:
    """A procedural person's crop, `size` px tall, with the middle half of its rows unknown."""
    body = load_body()
    shot = registry.load("people", registry.names("people")[0]).draw_person(0, body, 1).snapshots[0]
    state = np.where(shot.silhouette, MaskState.PERSON, MaskState.BACKGROUND).astype(np.uint8)
    whole = cut_view(TrainView(shot.image, state, shot.camera, shot.body_pose, 0, "0"), 0, body, size)
    unknown = np.zeros_like(whole.unknown)
    unknown[size // 4 : 3 * size // 4] = True
    return replace(whole, unknown=unknown, person=whole.person & ~unknown)


def _paint(backbone: Backbone, batch: DiffusionBatch, noise: Tensor, steps: int) -> Tensor:
    return sample(backbone, batch, noise, ANYBODY, steps=steps, use_parts=True)


def _exact(backbone: Backbone, batch: DiffusionBatch, noise: Tensor, many: int) -> Tensor:
    """[1, 3, H, W] the same painting in float64; the backbone is single again afterwards."""
    parts = (backbone.unet, backbone.controlnet, backbone.text_encoder, backbone.codec)
    try:
        for part in parts:
            part.double()
        wide = DiffusionBatch(
            *(t.double() for t in (batch.pixels, batch.unknown, batch.person, batch.parts, batch.seen))
        )
        return _paint(backbone, wide, noise.double(), many).double()
    finally:
        for part in parts:
            part.float()
