"""Stage 2 (stage2_oc.py): the hidden person, painted beside the stage-1 rendering of the same view.

One canvas a view: [left: the rendering | right: the visible person on the background], each half as wide as high is
two, so that the canvas is the square that the model knows. Painted is, in the right half, where stage 1 is opaque and
the person is not visible. The right half is kept.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ihbench.clock.events import Resumed
from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.diffusion.backbone import Backbone
from ihbench.diffusion.crops.crop_view import CropView, cut_to
from ihbench.diffusion.crops.person_crop import PersonCrop, person_crop
from ihbench.diffusion.sampling import inpaint_views
from ihbench.fit.big_pose.fitting import Colour
from ihbench.methods.occfusion.avatar import OccFusionAvatar
from ihbench.methods.occfusion.hidden import cut_states, frames_to_paint, visible
from ihbench.methods.occfusion.painted import Painted
from ihbench.methods.occfusion.spec import GENERATED, GENERATED_SAMPLED
from ihbench.scene.contracts import TrainingSet, TrainView
from ihbench.scene.spread import spread

SHOWN = 6  # canvases in the picture that the run leaves


def half_crop(view: TrainView, avatar: OccFusionAvatar, size: int) -> PersonCrop:
    """The window around the posed body, twice as high as wide, `size` px tall."""
    crop = person_crop(view.camera, avatar.body.pose(view.body_pose), size)
    width = max(crop.window_width, (crop.window_height + 1) // 2)
    height = 2 * width
    x0 = crop.x0 - (width - crop.window_width) // 2
    y0 = crop.y0 - (height - crop.window_height) // 2
    return PersonCrop(x0, y0, width, height, size // 2, size)


def canvas_of(view: TrainView, k: int, avatar: OccFusionAvatar, background: Colour, size: int) -> CropView:
    """The canvas of training view k, [size, size]: an image, what is known as person, what is asked, and the part map
    twice."""
    config = avatar.config
    crop = cut_states(cut_to(view, k, avatar.body, half_crop(view, avatar, size)), view, config)
    rgb, alpha = avatar.render(crop.camera, view.body_pose, background)
    drawn = np.rint(255 * rgb).astype(np.uint8)
    opaque = alpha > config.inpaint.opaque
    behind = np.rint(255 * np.array(background)).astype(np.uint8)
    own = np.where(crop.person[..., None], crop.image, behind)
    nothing = np.zeros_like(crop.person)
    return replace(
        crop,
        image=np.concatenate([drawn, own], 1),
        person=np.concatenate([alpha > 0.5, crop.person], 1),
        unknown=np.concatenate([nothing, opaque & crop.unknown], 1),
        parts=np.concatenate([crop.parts, crop.parts], 1),
        cells=np.concatenate([crop.cells, crop.cells], 1),
        crop=replace(crop.crop, width=size),
    )


def generated_images(
    avatar: OccFusionAvatar, training: TrainingSet, backbone: Backbone, seed: int, ledger: Ledger, progress: Progress
) -> dict[int, NDArray[np.uint8]]:
    """View -> the person without the occluder [H, W, 3] on the background. What is done is kept by the ledger."""
    saved = ledger.load_state(GENERATED)
    if saved is not None:
        tensors, meta = saved
        ledger.event(Resumed(GENERATED, len(meta["views"])))
        return {k: np.asarray(tensors[f"{k}"]) for k in meta["views"]}
    inpaint, settled = avatar.config.inpaint, avatar.config.inpaint.settled()
    views = {k: training.views[k] for k in frames_to_paint(training, avatar.config)}
    canvases = [canvas_of(view, k, avatar, training.background, backbone.size) for k, view in views.items()]
    canvases = [canvas for canvas in canvases if canvas.unknown.any()]
    images = inpaint_views(
        backbone, canvases, settled.prompt, progress,
        seed=seed, steps=settled.steps, use_parts=True, guidance=settled.guidance, noise_scale=settled.noise,
        batch=max(inpaint.batch // 2, 1), ledger=ledger if ledger.on_disk else None, state=GENERATED_SAMPLED,
        control_scale=settled.control, guess=settled.guess,
    )  # fmt: skip
    out = {}
    for canvas, image in zip(canvases, images, strict=True):
        view = views[canvas.index]
        out[canvas.index] = pasted(view, canvas, image, training.background)
    ledger.event(Painted("images", len(canvases), len(training.views), sum(int(c.unknown.sum()) for c in canvases)))
    if ledger.on_disk and canvases:
        from ihbench.files.pictures import encoded

        chosen = spread(len(canvases), SHOWN)
        rows = [np.concatenate([canvases[n].image, images[n]], 1) for n in chosen]
        ledger.artifact("inpainting.png", encoded(np.concatenate(rows, 0), "PNG"))
    ledger.save_state(
        GENERATED,
        {"none": np.zeros(1, np.uint8), **{f"{k}": image for k, image in out.items()}},
        {"views": list(out)},
    )
    return out


def pasted(view: TrainView, canvas: CropView, image: NDArray[np.uint8], background: Colour) -> NDArray[np.uint8]:
    """[H, W, 3] the right half of a painted canvas, in its place on the background; visible pixels as filmed."""
    half = image.shape[1] // 2
    crop = replace(canvas.crop, width=half)
    behind = np.broadcast_to(255 * np.array(background, np.float32), view.image.shape)
    whole = crop.paste(image[:, half:].astype(np.float32), behind)
    whole = np.clip(np.rint(whole), 0, 255).astype(np.uint8)
    return np.where(visible(view)[..., None], view.image, whole).astype(np.uint8)
