"""Every switch of OccFusion, with the value of the released code (tiangexiang/OccFusion f41e091).

Steps count from 1, over both fits together. `paper` is what was released; `quick` and `smoke` are the same schedule
in fewer steps.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

from ihbench.config_fields import STEPS, Within, check
from ihbench.errors import BadInput
from ihbench.fit.big_pose.config import WEIGHT, BigPoseConfig, in_steps
from ihbench.fit.big_pose.plan import parts_of_no_use
from ihbench.fit.gaussians.density_config import DensityConfig
from ihbench.metrics.weights import FILES, locate
from ihbench.scene.plan import Omission, SceneMeasure

SHARE = Within(0, 1)
RELEASED_STEPS, RELEASED_REFINE_STEPS = 1200, 1800
# statistics from 1201 on, changes after 1400, 1600, 1800, 2000, 2200 (stage3.py:204-213)
RELEASED_EVENTS = DensityConfig(after=RELEASED_STEPS, before=2300, every=200)
SD2_WANTED = (
    "the folder of Stable Diffusion 2 inpainting (diffusers layout: unet/ vae/ text_encoder/ tokenizer/ scheduler/, "
    "safetensors), which backbone sd2 needs"
)
SAM_WANTED = "the folder of HQ-SAM in transformers' layout, which silhouette sam needs"
# what mini's 64 words can say
ANYBODY = "a photo of a person"
ONE_PERSON = "one person alone in plain clothes, clean background of high contrast, two arms, two legs, one head"
NOT_ONE_PERSON = "several objects, occlusion, patterned clothes, wrong anatomy"
SILHOUETTE = "white silhouette of a whole person on a plain background"
NO_SILHOUETTE = (
    "incomplete limbs, incomplete trunk, twisted body, wrong anatomy, cropped, blurry, low quality, artifacts"
)
TWICE = "the same person standing in two different rooms, realistic, two arms, two legs"


@dataclass(frozen=True)
class InpaintConfig:
    """The diffusion model, and stages 0 and 2 that paint with it."""

    on: bool = True
    """Stages 0 and 2, and the score distillation of stage 1. Off: OccFusion's base, refined."""
    backbone: Literal["mini", "sd2"] = "mini"
    """The diffusion model: the small one that comes with the bench, or your own Stable Diffusion 2 inpainting."""
    weights: str = ""
    """Folder (diffusers layout, safetensors) or hub id of the weights. sd2 needs it; empty gives the shipped mini."""
    control_weights: str = ""
    """sd2: folder of a ControlNet for the part map, or of the 4-channel base UNet to make one from; empty makes one
    from the inpainting UNet. It stands where the released code has a ControlNet for OpenPose skeletons."""
    memory_lean: bool = False
    """sd2: checkpointed gradients, the autoencoder in slices and tiles: less memory, more time."""
    batch: Annotated[int, Within(1, 4096)] = 8
    """Crops a step, halved when memory runs out."""
    key_frames: Annotated[int, Within(0, 100_000)] = 0
    """Frames with hidden pixels that stages 0 and 2 paint at most, evenly spread; 0 for all."""
    mask_steps: Annotated[int | None, Within(1, 1000)] = None
    """Sampling steps of stage 0. None: 15 for sd2, 6 for mini."""
    steps: Annotated[int | None, Within(1, 1000)] = None
    """Sampling steps of stage 2. None: 35 for sd2, 6 for mini."""
    guidance: Annotated[float | None, Within(1, 1000)] = None
    """Classifier-free guidance of both; 1 is none. None: 7.5 for sd2, 1 for mini."""
    noise: Annotated[float | None, Within(0, 100)] = None
    """Scale of the noise that sampling starts from. None: 1 for sd2, 0 for mini, whose mean answer is the better."""
    control: Annotated[float | None, Within(0, 1000)] = None
    """Scale of what the ControlNet adds in stage 2; in stage 0 it is 1. None: 0.3 for sd2, as released; 1 for mini,
    which knows a body from the part map alone."""
    guess: bool | None = None
    """Whether the ControlNet guides in guess mode in stage 2. None: yes for sd2, as released; no for mini."""
    opaque: Annotated[float, SHARE] = 0.65
    """Stage 2 paints where stage 1's alpha is above this and the person is not visible."""
    reach: Annotated[float, Within(0, 100)] = 0.06
    """Stage 0 paints up to so far beside the posed body, as a share of its height; farther off, the background is
    known to be one. 100: all of the crop that is no visible person, as released."""
    silhouette: Literal["coverage", "grabcut", "sam"] = "coverage"
    """What finds the complete silhouette in a painted frame: half of the way from the background's colour to the
    person's, GrabCut, or HQ-SAM (the released code's)."""
    sam_weights: str = ""
    """Folder of HQ-SAM weights in transformers' layout, for silhouette "sam"."""

    def __post_init__(self) -> None:
        check(self, "--method.inpaint.")
        for name, holds, expected in (
            ("weights", not self.on or self.backbone != "sd2" or bool(self.weights), SD2_WANTED),
            ("sam_weights", not self.on or self.silhouette != "sam" or bool(self.sam_weights), SAM_WANTED),
        ):
            if not holds:
                raise BadInput(
                    f"--method.inpaint.{name.replace('_', '-')} {getattr(self, name)!r}: expected {expected}"
                )

    def settled(self) -> Painting:
        """The values in force, with the backbone's own in the place of None."""
        own = OWN[self.backbone]
        given = {name: getattr(self, name) for name in vars(own) if getattr(self, name, None) is not None}
        return replace(own, **given)


@dataclass(frozen=True)
class Painting:
    """What depends on the backbone."""

    mask_steps: int
    steps: int
    guidance: float
    noise: float
    control: float
    guess: bool
    mask_prompt: str
    mask_negative: str
    prompt: str


OWN = {
    "mini": Painting(6, 6, 1.0, 0.0, 1.0, False, ANYBODY, "", ANYBODY),
    "sd2": Painting(15, 35, 7.5, 1.0, 0.3, True, ONE_PERSON, NOT_ONE_PERSON, TWICE),
}


@dataclass(frozen=True)
class ScoreConfig:
    """Score distillation on alpha in stage 1."""

    weight: Annotated[float | None, WEIGHT] = None
    """Of the distillation, beside `pixels`. None: 20, as released with Stable Diffusion, for sd2; 1 for mini. 0
    leaves it out."""
    every: Annotated[int, Within(1, STEPS)] = 1
    """Steps between two of them, each with so many times the weight."""
    guidance: Annotated[float, Within(0, 1000)] = 0.0
    """Classifier-free guidance. 0, as released: of the prompts the negative one alone counts."""
    positive: str | None = None
    """Positive prompt; without effect at guidance 0. None: a white silhouette of a person for sd2, of any person for
    mini."""
    negative: str | None = None
    """Negative prompt. None: what a silhouette shall not be for sd2; for mini, which was told of persons alone, "a
    photo of a person"."""
    canonical: Annotated[float, SHARE] = 0.25
    """Share of them that look at the big pose from one of 18 sides, and not at the training view."""
    picture: Literal["silhouette", "composite"] | None = None
    """What is distilled: alpha in grey (released), or colours that are held fast, drawn with alpha over the
    background. None: composite for mini, which never saw a silhouette; silhouette for sd2."""
    context: Literal["nothing", "visible"] | None = None
    """What the model is shown of a training view: nothing, or the visible person beside what it is asked for. None:
    visible for mini, which was trained to complete; nothing for sd2, as released."""
    size: Annotated[int | None, Within(8, 2048)] = None
    """Side of the picture in px. None: 256 for sd2, as released; 128 for mini."""

    def __post_init__(self) -> None:
        check(self, "--method.score.")


@dataclass(frozen=True)
class RefineConfig:
    """Stage 3."""

    steps: Annotated[int, Within(0, STEPS)] = RELEASED_REFINE_STEPS
    """Optimisation steps after stage 1's; 0 leaves stages 2 and 3 out."""
    colour: Annotated[float, WEIGHT] = 2.0
    """Weight of the L1 where nothing is hidden."""
    mask: Annotated[float, WEIGHT] = 0.1
    """Weight of the mean squared error of alpha."""
    generated: Annotated[float, WEIGHT] = 0.1
    """Weight of the L1 to the generated image."""
    lpips: Annotated[float, WEIGHT] = 0.2
    """Weight of LPIPS to the generated image. Off, and said so, without its trunk's weights."""
    moments: Literal["released", "rescaled"] = "released"
    """Adam's moments from stage 1, whose loss is `pixels` times as large: as they are, so that Gaussians of stage 1
    hardly move for a thousand steps, or brought to the scale of this stage's loss."""

    def __post_init__(self) -> None:
        check(self, "--method.refine.")


@dataclass(frozen=True)
class OccFusionConfig(BigPoseConfig):
    hidden: Literal["not_visible", "unknown"] = "not_visible"
    """What may be hidden person: all that is not visible person, known background too (released, which knows two
    states), or the pixels whose truth is unknown."""
    steps: Annotated[int, Within(1, STEPS)] = RELEASED_STEPS
    """Optimisation steps of stage 1, one training view each."""
    pixels: Annotated[float, WEIGHT] = 1e4
    """Factor of all losses of stage 1 but the distillation."""
    mask: Annotated[float, WEIGHT] = 2.0
    """Weight of the mean squared error of alpha to the complete silhouette, in the box."""
    ssim: Annotated[float, WEIGHT] = 0.1
    """Weight of 1 - SSIM over visible pixels."""
    ssim_pixels: Literal["fixed", "released"] = "fixed"
    """Which entries of the SSIM map are averaged: those of the visible pixels, or those that the released code picks
    by taking channels for pixels."""
    lpips: Annotated[float, WEIGHT] = 0.1
    """Weight of LPIPS over visible pixels. Off, and said so, without its trunk's weights."""
    inpaint: InpaintConfig = field(default_factory=InpaintConfig)
    """The diffusion model, stages 0 and 2."""
    score: ScoreConfig = field(default_factory=ScoreConfig)
    """Score distillation on alpha."""
    refine: RefineConfig = field(default_factory=RefineConfig)
    """Stage 3."""
    density: DensityConfig = field(default_factory=lambda: RELEASED_EVENTS)
    """Cloning, splitting, merging and pruning, in stage 3 alone."""

    @property
    def last_step(self) -> int:
        return self.steps + self.refine.steps

    @property
    def distils(self) -> bool:
        """Whether stage 1 has score distillation."""
        return self.inpaint.on and self.settled_score().weight > 0

    def settled_score(self) -> Score:
        """The values in force, with the backbone's own in the place of None."""
        own = OWN_SCORE[self.inpaint.backbone]
        given = {name: getattr(self.score, name) for name in vars(own) if getattr(self.score, name) is not None}
        return replace(own, **given)

    def __post_init__(self) -> None:
        check(self, "--method.")


@dataclass(frozen=True)
class Score:
    """What of the distillation depends on the backbone."""

    weight: float
    positive: str
    negative: str
    picture: Literal["silhouette", "composite"]
    context: Literal["nothing", "visible"]
    size: int


OWN_SCORE = {
    "mini": Score(1.0, ANYBODY, ANYBODY, "composite", "visible", 128),
    "sd2": Score(20.0, SILHOUETTE, NO_SILHOUETTE, "silhouette", "nothing", 256),
}


def fewer(config: OccFusionConfig, share: float, faster: float) -> OccFusionConfig:
    """The schedule of a configuration in a share of its steps (`in_steps`)."""
    refine = replace(config.refine, steps=round(config.refine.steps * share))
    return in_steps(config, share, faster, steps=round(config.steps * share), refine=refine)


ON_A_CPU = OccFusionConfig(
    lpips=0.0,
    least_px=1.0,
    nearest_every=10,
    inpaint=InpaintConfig(key_frames=40),
    score=ScoreConfig(every=2),
    refine=RefineConfig(lpips=0.0, moments="rescaled"),
)

PAPER = OccFusionConfig()
QUICK = fewer(ON_A_CPU, 0.3, 2.5)
SMOKE = replace(
    fewer(ON_A_CPU, 0.025, 10.0),
    lr_position=8e-4,
    lr_scale=2e-2,
    inpaint=InpaintConfig(key_frames=4, mask_steps=2, steps=2),
    score=ScoreConfig(every=3),
)

PROFILES = {"smoke": SMOKE, "quick": QUICK, "paper": PAPER}


def leave_out(config: OccFusionConfig, scene: SceneMeasure) -> list[Omission]:
    """What this scene does not need of this configuration (see `ihbench.scene.plan`)."""
    out = parts_of_no_use(config, scene, ("fit/stage1", "fit/stage3"))
    if config.inpaint.on and scene.hidden_share == 0:
        reason = "nothing is hidden: the visible person is the complete one, and no pixel is to be painted"
        out.append(Omission("inpaint.on", False, reason, {"fit/stage0": 1.0, "fit/stage2": 1.0}))
    return out


def outside_files(config: OccFusionConfig) -> list[Path]:
    """Files and folders whose content affects the answer: weights that the configuration names, and the trunk of
    LPIPS, whose term is off while the file is not there."""
    inpaint, paths = config.inpaint, []
    if inpaint.on:
        named = (inpaint.weights, inpaint.control_weights, inpaint.sam_weights if inpaint.silhouette == "sam" else "")
        paths += [_folder(name) for name in named if name]
    if config.lpips > 0 or (config.refine.steps > 0 and config.refine.lpips > 0):
        trunk = locate(FILES[f"lpips-{config.lpips_net}"])
        paths.append(trunk if isinstance(trunk, Path) else None)
    return [path for path in paths if path is not None]


def _folder(name: str) -> Path | None:
    """A folder, or the cached snapshot of a hub id; None for what the run will complain of by itself."""
    from ihbench.diffusion.checkpoint import find_folder

    try:
        return find_folder(name, "")
    except BadInput:
        return None
