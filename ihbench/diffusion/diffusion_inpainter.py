"""The paper's inpainter: a diffusion model personalised to one person (sec. 3.3)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.diffusion.backbone import Backbone
from ihbench.diffusion.backbone_choice import load_chosen, look_at_chosen
from ihbench.diffusion.crops.crop_view import CropView
from ihbench.diffusion.crops.head_crop import A_PERSON_CROP
from ihbench.diffusion.inpaint_config import InpaintConfig
from ihbench.diffusion.personalise import Personaliser
from ihbench.diffusion.sampling import inpaint_views
from ihbench.diffusion.subject_token import ANYBODY, new_words
from ihbench.diffusion.tuning import Curve


def load_backbone(config: InpaintConfig, device: str) -> Backbone:
    """The backbone that a configuration names. Raises `BadInput` for weights that are missing, wrong or damaged."""
    return load_chosen(config, device)


def check_backbone(config: InpaintConfig) -> None:
    """Raises `BadInput` for what `load_backbone` and personalisation would complain of and a look at the folders can
    tell, before an hour of fitting."""
    tokenizer = look_at_chosen(config)
    if config.ti:
        new_words(tokenizer, config.token, config.settled().vectors, config.backbone)


class DiffusionInpainter:
    """A backbone, personalised by `learn` from the training views or left generic."""

    name = "diffusion"

    def __init__(self, backbone: Backbone, config: InpaintConfig, seed: int, ledger: Ledger):
        self.backbone, self.config, self.seed, self.ledger = backbone, config, seed, ledger
        self.prompt = ANYBODY
        self.curves: dict[str, Curve] = {}

    def learn(self, views: list[CropView], progress: Progress, adapt: bool = True) -> None:
        """Personalise, as far as the switches ti, lora and sg ask for it; without `adapt` the word alone. Changes the
        backbone."""
        if self.config.ti or self.config.lora or self.config.sg:
            person = Personaliser(self.backbone, views, self.config, self.seed, self.ledger)
            person.run(progress, adapt)
            self.prompt, self.curves = person.prompt, person.curves

    @property
    def paints_heads(self) -> bool:
        """Whether hidden heads are to be painted once more; never without semantic guidance."""
        return self.config.sg and (self.backbone.heads if self.config.heads is None else self.config.heads)

    def inpaint_heads(self, heads: list[CropView], progress: Progress) -> list[NDArray[np.uint8]]:
        """Head crops, each completed from what it begins with (`fill`). By the backbone as it was before it was
        personalised, which is from crops of whole persons alone."""
        if not heads:
            return []
        settled = self.config.settled()
        return inpaint_views(
            load_backbone(self.config, str(self.backbone.device)), heads, ANYBODY, progress,
            seed=self.seed, steps=settled.sampler_steps, use_parts=True, noise_scale=settled.noise,
            batch=A_PERSON_CROP * self.config.batch,
        )  # fmt: skip

    def inpaint(self, views: list[CropView], progress: Progress) -> list[NDArray[np.uint8]]:
        settled = self.config.settled()
        return inpaint_views(
            self.backbone, views, self.prompt, progress,
            seed=self.seed, steps=settled.sampler_steps, use_parts=self.config.sg, guidance=settled.guidance,
            noise_scale=settled.noise, batch=self.config.batch,
            ledger=self.ledger if self.ledger.on_disk else None,
        )  # fmt: skip
