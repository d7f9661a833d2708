"""The simple inpainters by name, which the diffusion model is measured against."""

from __future__ import annotations

from ihbench.body import Body
from ihbench.diffusion.crops.crop_view import Inpainter
from ihbench.methods.inpainthuman.inpainting.colour_fills import IMAGE_FILLS, MeanColour, PushPull
from ihbench.methods.inpainthuman.inpainting.texture_fills import MirroredTexture, TemporalCopy


def simple_inpainters(body: Body, background: tuple[float, float, float]) -> dict[str, Inpainter]:
    """Name -> inpainter, in the order of tables. `background` is RGB in [0, 1]."""
    known: tuple[Inpainter, ...] = (
        MeanColour(background),
        *IMAGE_FILLS,
        PushPull(background),
        MirroredTexture(body, background),
        TemporalCopy(body, background),
    )
    return {inpainter.name: inpainter for inpainter in known}
