"""Every switch of GTU, with the value of the released code (snuvclab/gtu 6b3026c), single person, masks, no scene.

Iterations count from 1, score distillation (SDS) steps too. What `paper` says is what was released; `quick` and
`smoke` are the same schedule in fewer iterations.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

from ihbench.config_fields import STEPS, Within, check
from ihbench.diffusion.backbone_choice import cached_folders
from ihbench.errors import BadInput
from ihbench.fit.gaussians.density_config import DensityConfig
from ihbench.metrics.weights import FILES, locate
from ihbench.scene.plan import Omission, SceneMeasure

WEIGHT, RATE, SHARE = Within(0, 1e12), Within(0, 1000), Within(0, 1)
COUNT = Within(0, STEPS)
TOKEN = "<someone>"
Context = Literal["none", "seen"]
Backdrop = Literal["random", "protocol"]

# scene/gaussian_model.py:564-612: 3DGS's growth without any gate
RELEASED_DENSITY = DensityConfig(
    after=1500, before=3500, every=500, gradient=5e-5, size=0.01, clone="in_place", kl_grow=None, kl_merge=None,
    faint=0.005, largest=0.05,
)  # fmt: skip

NOTHING_UNSEEN = 0.002  # share of the texels that no frame shows; fewer are specks
ONE_SIDE_DEG = 10.0  # a person who turns by less is seen from one direction: colours by direction are one colour
# shares of a stage's seconds, estimated
SDS_SHARE = 0.5
DIRECTION_SHARE = 0.01


@dataclass(frozen=True)
class IdentityConfig:
    """Fine-tuning of the diffusion model to the person (Custom Diffusion): a word, and the keys and values of the
    UNet's cross-attention."""

    on: bool = True
    """Off: the model guesses for anybody."""
    token: str = TOKEN
    """The new word, `<new1>` in the released code."""
    vectors: Annotated[int | None, Within(1, 64)] = None
    """Word vectors of it. None: 4 for mini, which was trained with so many; 1 for sd2, as released."""
    steps: Annotated[int, Within(1, STEPS)] = 1000
    """Steps of AdamW."""
    batch: Annotated[int, Within(1, 4096)] = 2
    """Pictures a step, halved when memory runs out."""
    lr: Annotated[float | None, Within(0, 1000, above=True)] = None
    """AdamW's step size of keys and values. None: 1e-5 for sd2, as released; 5e-4 for mini."""
    word_lr: Annotated[float | None, Within(0, 1000, above=True)] = None
    """AdamW's step size of the word's vectors. None: 1e-5 for sd2, as released; 2e-2 for mini."""
    weight_decay: Annotated[float, SHARE] = 0.01
    """AdamW's weight decay."""
    background: Annotated[float, SHARE] = 0.5
    """Weight of pixels known to show no person."""

    def __post_init__(self) -> None:
        check(self, "--method.identity.")
        if not self.token.strip() or " " in self.token:
            raise BadInput(f"--method.identity.token {self.token!r}: expected one word")


@dataclass(frozen=True)
class Settled:
    """The fields that depend on the backbone."""

    guidance: float
    context: Context
    sds_backdrop: Backdrop
    vectors: int
    lr: float
    word_lr: float


OWN = {
    "mini": Settled(guidance=2.0, context="seen", sds_backdrop="protocol", vectors=4, lr=5e-4, word_lr=2e-2),
    "sd2": Settled(guidance=50.0, context="none", sds_backdrop="random", vectors=1, lr=1e-5, word_lr=1e-5),
}


@dataclass(frozen=True)
class GtuConfig:
    unknown: Literal["ignore", "background"] = "ignore"
    """What a hidden pixel is taken for. ignore: the released system's own occluder mask, which takes it out of every
    loss. background: a run without occluder masks, in which the occluder carves the person."""
    steps: Annotated[int, Within(1, STEPS)] = 12_010
    """Iterations, one training view each; after `photo_steps` each is two steps of one Adam."""
    photo_steps: Annotated[int, COUNT] = 1000
    """Iterations before score distillation begins."""
    sds: bool = True
    """Score distillation from random views: guess what nobody saw."""
    sds_every: Annotated[int, Within(1, STEPS)] = 1
    """Score distillation in every so many iterations."""
    second_stage: Annotated[int, COUNT] = 2000
    """SDS step from which the noise range reaches down to .3 and its upper end falls, and views are closer."""
    third_stage: Annotated[int, COUNT] = 4000
    """SDS step from which the noise range is .02 to .3."""
    coarse_steps: Annotated[int, COUNT] = 1000
    """SDS steps in which views are drawn at half the backbone's size."""
    photo_gain: Annotated[float, WEIGHT] = 1e6
    """Weight of the photos, times the square of the noise range's upper end, once score distillation has begun.
    Adam is shared, so this is what keeps score distillation off surface that a photo shows."""
    statistics: Literal["released", "photos"] = "released"
    """Density control looks at screen gradients of the weighted loss and of score distillation, or at those of the
    photos' loss without its weight."""
    close_ups: bool = True
    """Views of head, upper and lower body among the random ones; else whole bodies alone."""
    guidance: Annotated[float | None, Within(1, 1000)] = None
    """Classifier-free guidance. None: 50 for sd2, as released; 2 for mini."""
    context: Context | None = None
    """What the inpainting backbone is shown of a random view: nothing, or what the avatar draws of surface that a
    training view showed. None: seen for mini, which was made for that; none for sd2, as released."""
    sds_backdrop: Backdrop | None = None
    """Colour behind the body in random views: random, or the protocol's. None: random for sd2, as released; the
    protocol's for mini, which has only seen people on white."""
    backbone: Literal["mini", "sd2"] = "mini"
    """The diffusion model: the small one that comes with the bench, or your own Stable Diffusion 2 inpainting."""
    weights: str = ""
    """Folder (diffusers layout, safetensors) or hub id of the weights. sd2 needs it; empty gives the shipped mini."""
    control_weights: str = ""
    """sd2: folder of a ControlNet for the part map, or of the 4-channel base UNet to make one from; empty makes one
    from the inpainting UNet."""
    memory_lean: bool = False
    """sd2: checkpointed gradients, the autoencoder in slices and tiles: less memory, more time."""
    identity: IdentityConfig = field(default_factory=IdentityConfig)
    """Fine-tuning of the diffusion model to the person."""
    density: DensityConfig = field(default_factory=lambda: RELEASED_DENSITY)
    """Cloning, splitting and pruning; vertices of the body are never removed."""
    prune_until: Annotated[int, COUNT] = 7000
    """After `density.before` Gaussians are only pruned, until this iteration …"""
    prune_largest: Annotated[float, Within(0, 1e6, above=True)] = 0.5
    """… those larger than this in m, and the faint ones."""
    reset_until: Annotated[int, COUNT] = 1500
    """Before this iteration the body's vertices get their place and size back after each, and a floor of opacity."""
    opacity: Annotated[float, Within(0, 1, above=True)] = 0.9
    """Opacity of the first Gaussians."""
    opacity_floor: Annotated[float, SHARE] = 0.7
    """That floor."""
    grey: Annotated[float, SHARE] = 0.5
    """Colour of the first Gaussians."""
    sh_degree: Annotated[int, Within(0, 3)] = 2
    """Highest degree of the spherical harmonics."""
    sh_every: Annotated[int, Within(1, STEPS)] = 2000
    """Every so many iterations the degree in use rises by one, from 0."""
    grid: Annotated[int, Within(2, 256)] = 64
    """Points along a side of the grid of skinning weights."""
    box: Annotated[float, Within(1, 10)] = 1.1
    """Views are compared in the projected body's box, this many times as wide and high."""
    dilation: Annotated[float, SHARE] = 0.03
    """Occluder masks grow by a square of this share of width + height."""
    ssim: Annotated[float, SHARE] = 0.2
    """Weight of 1 - SSIM; that of L1 is the rest of 1."""
    lpips: Annotated[float, WEIGHT] = 0.1
    """Weight of LPIPS. Off, and said so, without its trunk's weights."""
    lpips_net: Literal["vgg", "alex", "squeeze"] = "vgg"
    """Trunk of LPIPS."""
    opaque: Annotated[float, WEIGHT] = 0.1
    """Weight of the term that pushes alpha to 0 or 1; in random views times the photos' weight."""
    lr_position: Annotated[float, RATE] = 1e-3
    """Adam's step size of centres in m …"""
    lr_position_end: Annotated[float, RATE] = 2e-6
    """… and what it falls to, log-linearly …"""
    position_hold: Annotated[int, COUNT] = 1000
    """… after this iteration …"""
    position_decay: Annotated[int, Within(1, 100 * STEPS)] = 6000
    """… over so many."""
    lr_scale: Annotated[float, RATE] = 5e-3
    """Adam's step size of the logarithms of scales."""
    lr_rotation: Annotated[float, RATE] = 1e-3
    """Adam's step size of quaternions."""
    lr_opacity: Annotated[float, RATE] = 0.05
    """Adam's step size of opacity logits."""
    lr_colour: Annotated[float, RATE] = 2.5e-3
    """Adam's step size of spherical harmonics of degree 0; those above have a twentieth of it."""
    lr_pose: Annotated[float, RATE] = 1e-4
    """Adam's step size of the training frames' poses, root orientation included; 0 leaves them."""

    @property
    def highest_degree(self) -> int:
        """The degree of the spherical harmonics in the last iteration."""
        return min(self.sh_degree, self.steps // self.sh_every)

    def degree_at(self, step: int) -> int:
        """The degree in use in an iteration."""
        return min(self.sh_degree, step // self.sh_every)

    @property
    def guesses(self) -> bool:
        """Whether any iteration has score distillation."""
        return self.sds and self.steps > self.photo_steps

    def settled(self) -> Settled:
        """The values that are in force, with the backbone's own in the place of None."""
        asked = vars(self) | vars(self.identity)
        own = OWN[self.backbone]
        return replace(own, **{name: asked[name] for name in vars(own) if asked[name] is not None})

    def __post_init__(self) -> None:
        check(self, "--method.")
        if self.third_stage < self.second_stage:
            raise BadInput(
                f"--method.third-stage {self.third_stage}: expected at least --method.second-stage, "
                f"{self.second_stage}"
            )
        if self.backbone == "sd2" and self.guesses and not self.weights:
            raise BadInput(
                "--method.weights '': expected the folder of Stable Diffusion 2 inpainting (diffusers layout: unet/ "
                "vae/ text_encoder/ tokenizer/ scheduler/, safetensors), which backbone sd2 needs"
            )


def in_steps(config: GtuConfig, steps: int, photo_steps: int, sds_every: int, faster: float) -> GtuConfig:
    """A configuration's schedule in fewer iterations: events at the same shares of all iterations, stages of the
    noise at the same shares of all SDS steps; what has to travel far goes `faster`."""
    share = steps / config.steps
    guesses = (steps - photo_steps) // sds_every / (config.steps - config.photo_steps)
    density = config.density
    return replace(
        config,
        steps=steps,
        photo_steps=photo_steps,
        sds_every=sds_every,
        second_stage=round(config.second_stage * guesses),
        third_stage=round(config.third_stage * guesses),
        coarse_steps=0,
        density=replace(
            density,
            after=round(density.after * share),
            before=round(density.before * share),
            every=max(round(density.every * share), 1),
            clone="off",
            split=False,
        ),
        prune_until=round(config.prune_until * share),
        reset_until=round(config.reset_until * share),
        sh_every=max(round(config.sh_every * share), 1),
        position_hold=round(config.position_hold * share),
        position_decay=max(round(config.position_decay * share), 1),
        lr_opacity=config.lr_opacity * faster,
        lr_colour=config.lr_colour * faster,
        lr_pose=config.lr_pose * faster,
    )


PAPER = GtuConfig()
# LPIPS through VGG would take several times as long as all the rest of an iteration
QUICK = replace(in_steps(PAPER, 700, 300, 2, 2.0), lpips=0.0, identity=IdentityConfig(steps=100, batch=4))
SMOKE = replace(in_steps(PAPER, 60, 40, 5, 8.0), lpips=0.0, grid=32, identity=IdentityConfig(steps=4, batch=2))

PROFILES = {"smoke": SMOKE, "quick": QUICK, "paper": PAPER}


def leave_out(config: GtuConfig, scene: SceneMeasure) -> list[Omission]:
    """What this scene does not need of this configuration (see `ihbench.scene.plan`)."""
    out = []
    unseen = scene.hidden_texels + scene.never_seen_texels
    if config.guesses and unseen < NOTHING_UNSEEN:
        reason = f"{1 - unseen:.1%} of the surface is seen in some training frame: there is nothing to guess"
        out.append(Omission("sds", False, reason, {"fit/identity": 1.0, "fit/gaussians": SDS_SHARE}))
    if config.highest_degree > 0 and max(scene.turn_deg, scene.motion_deg) < ONE_SIDE_DEG:
        reason = (
            f"the person turns by {scene.turn_deg:.1f}° and moves by {scene.motion_deg:.1f}°: every point is seen "
            "from one direction"
        )
        out.append(Omission("sh_degree", 0, reason, {"fit/gaussians": DIRECTION_SHARE}))
    return out


def outside_files(config: GtuConfig) -> list[Path]:
    """Files and folders whose content affects the answer: weights that the configuration names, and the trunk of
    LPIPS, whose term is off while the file is not there."""
    paths = cached_folders([config.weights, config.control_weights]) if config.guesses else []
    trunk = locate(FILES[f"lpips-{config.lpips_net}"]) if config.lpips > 0 else None
    return [*paths, *([trunk] if isinstance(trunk, Path) else [])]
