"""Every switch of InpaintHuman, with the paper's or the closest released code's value and why it is there.

Section numbers are the paper's; where the paper is silent the value follows GaussianAvatar (aipixel/GaussianAvatar),
whose representation the paper builds on.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from ihbench.config_fields import STEPS, MultipleOf, Within, check
from ihbench.diffusion.backbone_choice import cached_folders
from ihbench.diffusion.inpaint_config import PAPER_INPAINT, QUICK_INPAINT, InpaintConfig
from ihbench.errors import BadInput
from ihbench.fit.precision_name import Precision
from ihbench.fit.prior_config import PriorConfig
from ihbench.methods.inpainthuman.refine_config import PAPER_REFINE, QUICK_REFINE, RefineConfig
from ihbench.metrics.weights import FILES, locate
from ihbench.scene.plan import Omission, SceneMeasure, useful_texels

WEIGHT, RATE = Within(0, 1e6), Within(0, 1000)  # of a term of the loss; a step size
STATIC_DEG = 5.0  # below this joint motion nothing depends on the pose
NOTHING_HIDDEN = 0.002  # share of the texels that no frame shows although one faces them; fewer are specks
PART_TURN = 0.05  # share of the texels that never face the camera, above which the person turns only in part
GLANCING = 0.5  # cosine; a person who turns in part shows what lies beside the unseen side at less than this
FINEST_LEVEL = 3.0  # a level whose texels are this many times finer than the pixels cannot be told apart by them
ONE_FIT_STEPS = 1.175  # of stage 1's: with these, one fit is as good as stages 1 and 3 with half as many steps more
ONE_FIT_SSIM = 0.2  # weight; stage 3's (sec. 3.4)

# shares of a step's time, measured at the quick profile
RESIDUAL_SHARE = 0.13
LEVEL_SHARE = 0.07  # of each level
POINTS_SHARE = 0.87  # of what grows with the number of Gaussians
TI_SHARE = 0.2  # of stage 2
ONE_FIT_SHARE = 0.2  # more, for more steps and the SSIM


@dataclass(frozen=True)
class InpaintHumanConfig:
    texels: Annotated[int, Within(8, 4096)] = 256
    """One Gaussian per texel of a square UV grid of this side: 256 gives about 50 k, 512 about 200 k."""
    levels: Annotated[tuple[int, ...], Within(4, 4096)] = (64, 128, 256)
    """Sides of the UV feature maps, coarse to fine (sec. 4.2). A single value gives single-scale features."""
    channels: Annotated[int, Within(1, 1024)] = 32
    """Feature channels per level (sec. 4.2)."""
    fusion: Literal["sum", "concat"] = "sum"
    """How levels are joined. The paper sums; concat widens the decoder's input instead."""
    feature_std: Annotated[float, Within(0, 100)] = 0.01
    """Standard deviation of the feature maps' initial values."""
    canonical_pose: Literal["a_pose", "gaussianavatar", "big_pose", "vitruvian", "t_pose"] = "a_pose"
    """Pose in which points live and are position-encoded (sec. 3.2: "A-pose")."""
    encoding_frequencies: Annotated[int, Within(0, 32)] = 6
    """Octaves of the positional encoding of canonical points. More lets the decoder bypass the UV maps."""
    decoder_layers: Annotated[int, Within(1, 64)] = 3
    """Linear layers of the decoder (sec. 4.2)."""
    decoder_width: Annotated[int, Within(1, 8192)] = 128
    """Hidden width of the decoder (sec. 4.2)."""
    offset: Literal["linear", "tanh"] = "linear"
    """Output form of the offset from the surface: offset_scale × output, bounded by tanh or not."""
    offset_scale: Annotated[float, Within(0, 10)] = 0.02
    """Metres per unit of the decoder's offset output (GaussianAvatar)."""
    scale_activation: Literal["softplus", "exp"] = "exp"
    """Turns the decoder's output into a factor on the initial scale."""
    scale_initial: Annotated[float, Within(0, 100, above=True)] = 0.7
    """Initial Gaussian scale as a multiple of the local texel spacing on the body."""
    scale_limit: Annotated[float, Within(0, 10, above=True)] = 0.02
    """Upper bound of a Gaussian's scale in metres."""
    pose_residual: bool = True
    """Pose-dependent residual features from the position map (sec. 3.2, dynamics)."""
    position_map: Annotated[int, Within(16, 2048), MultipleOf(8)] = 32
    """Side of the position map that the residual encoder reads (128 in the paper profile)."""
    residual_channels: Annotated[int, Within(4, 1024), MultipleOf(4)] = 16
    """Base width of the residual encoder (32 in the paper profile)."""
    residual_start: Annotated[float, Within(0, 1)] = 0.3
    """Share of the steps after which the residual joins; earlier it would absorb what belongs to the maps."""
    background_weight: Annotated[float, WEIGHT] = 1.0
    """Weight of the L1 on pixels known to be background. Without it nothing bounds the silhouette."""
    background_rim: Annotated[float, Within(0, 1)] = 0.04
    """Known background is not learned nearer to unknown pixels than this share of the longer side of the body's
    window."""
    offset_weight: Annotated[float, WEIGHT] = 10.0
    """Weight of the mean squared offset in m² of points that some training view shows (GaussianAvatar)."""
    scale_weight: Annotated[float, WEIGHT] = 0.03
    """Weight of the mean scale in m of points that some training view shows (GaussianAvatar)."""
    feature_weight: Annotated[float, WEIGHT] = 1.0
    """Weight of the mean squared feature."""
    prior: PriorConfig = field(default_factory=PriorConfig)
    """Points that few views show take after their neighbours, in stages 1 and 3."""
    ssim: Annotated[float, WEIGHT] = 0.2
    """Weight of 1 - SSIM over visible person pixels in stage 1 (the paper has it in stage 3 alone)."""
    ssim_every: Annotated[int, Within(1, 1000)] = 2
    """Steps between two that have the SSIM of stages 1 and 3, at so many times its weight."""
    precision: Precision = "auto"
    """Of decoder and encoder while fitting: auto takes bfloat16 where a measurement says that it pays."""
    steps: Annotated[int, Within(1, STEPS)] = 400
    """Optimisation steps, one training view each."""
    lr_maps: Annotated[float, RATE] = 2e-2
    """AdamW step size of the UV feature maps (1e-4 in the paper)."""
    lr_decoder: Annotated[float, RATE] = 1e-2
    """AdamW step size of the decoder (1e-4 in the paper)."""
    lr_encoder: Annotated[float, RATE] = 1e-3
    """AdamW step size of the residual encoder (1e-4 in the paper)."""
    lr_final: Annotated[float, Within(0, 1)] = 0.02
    """Step sizes fall along a cosine to this share of their start."""
    crop: bool = True
    """While fitting, draw only the window around the body. Off: the whole image. Changes the time of a step only."""
    clip_gradient: Annotated[float, Within(0, float("inf"), above=True)] = 1.0
    """Bound on the norm of each group's gradient."""
    cull: bool = True
    """While fitting, leave out Gaussians that the posed body hides, before they are decoded. Changes the time of a
    step, hardly its image. Pictures are drawn with all of them."""
    one_fit: bool = False
    """Nothing is painted, and stages 1 and 3 are one: stage 1 with some more steps. What the plan makes of a scene
    where nothing is hidden."""
    paper_strict: bool = False
    """Follow the paper's text where it differs from sensible defaults: no background term, no regularisers."""
    inpaint: InpaintConfig = field(default_factory=lambda: QUICK_INPAINT)
    """Stage 2: what no frame shows is painted."""
    refine: RefineConfig = field(default_factory=lambda: QUICK_REFINE)
    """Stage 3: the avatar learns from the painted frames."""

    @property
    def fit_steps(self) -> int:
        """Steps of stage 1 as they are taken."""
        return round(ONE_FIT_STEPS * self.steps) if self.one_fit else self.steps

    @property
    def paints(self) -> bool:
        """Whether there are stages 2 and 3."""
        return self.inpaint.on and not self.one_fit

    def __post_init__(self) -> None:
        check(self, "--method.")
        if not self.levels:
            raise BadInput("--method.levels (): expected one side or more, each 4 to 4096")


QUICK = InpaintHumanConfig()

PAPER = InpaintHumanConfig(
    texels=512,
    steps=3000,
    position_map=128,
    ssim_every=1,
    residual_channels=32,
    lr_maps=1e-4,
    lr_decoder=1e-4,
    lr_encoder=1e-4,
    lr_final=1.0,
    inpaint=PAPER_INPAINT,
    refine=PAPER_REFINE,
)

PROFILES = {"quick": QUICK, "paper": PAPER}


def leave_out(config: InpaintHumanConfig, scene: SceneMeasure) -> list[Omission]:
    """What this scene does not need of this configuration (see `ihbench.scene.plan`)."""
    out = []
    if config.pose_residual and scene.motion_deg < STATIC_DEG:
        reason = f"no joint turns more than {scene.motion_deg:.1f}° over the training frames (limit {STATIC_DEG}°)"
        out.append(Omission("pose_residual", False, reason, _both_fits(RESIDUAL_SHARE)))
    useful = tuple(r for r in config.levels if scene.texel_mm(r) * FINEST_LEVEL >= scene.pixel_mm)
    useful = useful or (min(config.levels),)
    if useful != config.levels:
        reason = (
            f"a pixel covers {scene.pixel_mm:.1f} mm of the body; levels {config.levels} go down to "
            f"{scene.texel_mm(max(config.levels)):.1f} mm"
        )
        out.append(Omission("levels", useful, reason, _both_fits(LEVEL_SHARE * (len(config.levels) - len(useful)))))
    texels = useful_texels(scene, config.texels)
    if texels != config.texels:
        reason = (
            f"a pixel covers {scene.pixel_mm:.1f} mm of the body; {config.texels}² Gaussians stand "
            f"{scene.texel_mm(config.texels):.1f} mm apart"
        )
        share = POINTS_SHARE * (1 - (texels / config.texels) ** 2)
        out.append(Omission("texels", texels, reason, _both_fits(share)))
    inpaint = config.inpaint
    paints = config.paints and (scene.hidden_texels > NOTHING_HIDDEN or inpaint.always or inpaint.turntable > 0)
    if paints and inpaint.ti and inpaint.uses_diffusion and inpaint.backbone == "mini" and not inpaint.weights:
        reason = "a word is worth 0.00 dB to the small model that comes with the bench"
        out.append(Omission("inpaint.ti", False, reason, {"fit/stage2": TI_SHARE}))
    if not config.paints or inpaint.always or inpaint.context != "seen" or inpaint.turntable:
        return out  # a turntable shows all from the front
    if scene.hidden_texels <= NOTHING_HIDDEN:
        if _one_fit_does(config):
            reason = (
                f"of the surface {scene.hidden_texels:.1%} is hidden whenever it faces the camera: nothing to paint, "
                "and one fit does for both"
            )
            spares = {"fit/stage1": -ONE_FIT_SHARE, "fit/stage2": 1.0, "fit/stage3": 1.0}
            out.append(Omission("one_fit", True, reason, spares))
    elif inpaint.facing < GLANCING and scene.never_seen_texels > PART_TURN:
        reason = (
            f"{scene.never_seen_texels:.0%} of the surface never faces the camera: what is beside it is seen edge-on "
            "and few pixels would say what it looks like from the front"
        )
        out.append(Omission("inpaint.facing", GLANCING, reason))
    return out


def _one_fit_does(config: InpaintHumanConfig) -> bool:
    """Whether one fit is known to be as good as stages 1 and 3: with stage 3 as in the quick profile, no LPIPS."""
    refine = config.refine
    as_measured = 0 < 2 * refine.steps <= config.steps and (refine.weight, refine.ssim) == (1.0, ONE_FIT_SSIM)
    return as_measured and not config.paper_strict and _trunk(refine) is None


def _both_fits(share: float) -> dict[str, float]:
    """A share of the seconds of both stages that optimise the avatar."""
    return {"fit/stage1": share, "fit/stage3": share}


def outside_files(config: InpaintHumanConfig) -> list[Path]:
    """Files and folders whose content affects the answer: weights that the configuration names, and the trunk of
    LPIPS, whose term is off while the file is not there."""
    inpaint = config.inpaint
    if not config.paints:
        return []
    named = [inpaint.weights, inpaint.control_weights] if inpaint.uses_diffusion else []
    named += [inpaint.sam_weights] if inpaint.silhouette == "sam" else []
    paths = [*cached_folders(named), _trunk(config.refine)]
    return [path for path in paths if path is not None]


def _trunk(refine: RefineConfig) -> Path | None:
    """The file of LPIPS's trunk, where stage 3 has that term: where it is wanted and the file is there."""
    if not (refine.steps > 0 and refine.weight > 0 and refine.lpips > 0):
        return None
    trunk = locate(FILES[f"lpips-{refine.lpips_net}"])
    return trunk if isinstance(trunk, Path) else None
