"""Every switch of GaussianAvatar, with the released code's value (aipixel/GaussianAvatar at d981c62)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from ihbench.config_fields import STEPS, MultipleOf, Within, check
from ihbench.metrics.weights import FILES, locate
from ihbench.scene.plan import Omission, SceneMeasure, useful_texels

WEIGHT, RATE = Within(0, 1e6), Within(0, 1000)  # of a term of the loss; a step size
STATIC_DEG = 5.0  # below this joint motion nothing depends on the pose
POINTS_SHARE = 0.8  # of a step's time, what grows with the number of texels (measured at the quick profile)


@dataclass(frozen=True)
class GaussianAvatarConfig:
    texels: Annotated[int, Within(8, 4096)] = 512
    """One Gaussian per texel of a square UV grid of this side: 512 gives about 200 k."""
    feature_map: Annotated[int, Within(4, 1024)] = 128
    """Side of the learned feature map."""
    channels: Annotated[int, Within(1, 1024)] = 64
    """Its channels."""
    width: Annotated[int, Within(1, 8192)] = 128
    """Hidden width of the decoder."""
    feature_std: Annotated[float, Within(0, 100)] = 0.01
    """Standard deviation of the feature map's initial values."""
    offset_scale: Annotated[float, Within(0, 10)] = 0.02
    """Metres per unit of the decoder's offset output, which has no bound."""
    decoded: Literal["all", "charts"] = "all"
    """Texels that are decoded: of the whole grid as released, or those on the body's charts alone. Batch statistics
    and the means of the loss are taken over these."""
    batch_norm: Literal["released", "mended"] = "released"
    """Statistics of the batch norms after the fit: of whatever is decoded, as released, where nothing calls eval();
    or measured once over the training poses and held."""
    unknown: Literal["background", "ignore"] = "background"
    """What pixels behind the occluder are: background-coloured like all outside the mask, as released; or nothing."""
    schedule: Literal["released", "epochs"] = "released"
    """Step sizes fall to a tenth after 66 and 133 iterations, as released; or after 66 and 133 of 200 epochs, as the
    numbers look meant."""
    batch: Annotated[int, Within(1, 64)] = 2
    """Views a step; an epoch leaves out those that fill no batch."""
    epochs: Annotated[int, Within(1, 100_000)] = 200
    """Passes over the views; weights that change with the epoch (offset, LPIPS) and `schedule` count in them."""
    steps: Annotated[int, Within(0, STEPS)] = 0
    """Optimisation steps, `epochs` epochs of equal length whatever the number of views; 0: as many as whole passes
    take."""
    scale_ramp: Annotated[int, Within(1, STEPS)] = 1000
    """Steps over which the drawn scale rises from nothing to the decoded one, which starts at half a metre."""
    lr_network: Annotated[float, RATE] = 3e-3
    """Adam's step size of smoothing and decoder."""
    lr_features: Annotated[float, RATE] = 5e-4
    """Adam's step size of the feature map."""
    l1: Annotated[float, WEIGHT] = 0.8
    """Weight of the mean absolute error over the whole image."""
    ssim: Annotated[float, WEIGHT] = 0.2
    """Weight of 1 - SSIM over the whole image."""
    lpips: Annotated[float, WEIGHT] = 0.2
    """Weight of LPIPS (AlexNet) of the whole image; off where its weights are missing, the record says so."""
    lpips_epoch: Annotated[int, Within(1, 100_000)] = 31
    """The first epoch that has it."""
    scale_weight: Annotated[float, WEIGHT] = 0.03
    """Weight of the mean drawn scale in m."""
    offset_weight: Annotated[float, WEIGHT] = 10.0
    """Weight of the mean squared offset in m²; falls to 0.85 of itself every 20 epochs."""
    feature_weight: Annotated[float, WEIGHT] = 1.0
    """Weight of the mean squared feature."""
    pose_stage: bool = False
    """Stage 2: features from a map of the posed body's positions are added, the feature map is frozen. Off as for the
    authors' own results."""
    pose_steps: Annotated[int, Within(0, STEPS)] = 0
    """Steps of stage 2; 0: as many as stage 1."""
    pose_feature_weight: Annotated[float, WEIGHT] = 10.0
    """Weight of the mean squared pose feature."""
    network_rate_share: Annotated[float, Within(0, 1)] = 0.1
    """Of their step size in stage 1, what smoothing and decoder have in stage 2."""

    def __post_init__(self) -> None:
        check(self, "--method.")
        if self.pose_stage:
            check(_PoseMap(self.feature_map), "--method.")


@dataclass(frozen=True)
class _PoseMap:
    """What stage 2 asks of the feature map: its encoder halves a map five times."""

    feature_map: Annotated[int, Within(32, 1024), MultipleOf(32)]


PAPER = GaussianAvatarConfig()

QUICK = replace(
    PAPER, texels=128, channels=32, decoded="charts", schedule="epochs", batch=1, steps=300, scale_ramp=150
)

SMOKE = replace(QUICK, texels=32, feature_map=32, channels=32, steps=100, scale_ramp=100)

PROFILES = {"smoke": SMOKE, "quick": QUICK, "paper": PAPER}


def leave_out(config: GaussianAvatarConfig, scene: SceneMeasure) -> list[Omission]:
    """What this scene does not need of this configuration (see `ihbench.scene.plan`)."""
    out = []
    texels = useful_texels(scene, config.texels)
    if texels != config.texels:
        reason = (
            f"a pixel covers {scene.pixel_mm:.1f} mm of the body; {config.texels}² Gaussians stand "
            f"{scene.texel_mm(config.texels):.1f} mm apart"
        )
        share = POINTS_SHARE * (1 - (texels / config.texels) ** 2)
        out.append(Omission("texels", texels, reason, {"fit/stage1": share, "fit/stage2": share}))
    if config.pose_stage and scene.motion_deg < STATIC_DEG:
        reason = f"no joint turns more than {scene.motion_deg:.1f}° over the training frames (limit {STATIC_DEG}°)"
        out.append(Omission("pose_stage", False, reason, {"fit/stage2": 1.0}))
    return out


def outside_files(config: GaussianAvatarConfig) -> list[Path]:
    """The trunk of LPIPS, whose term is off while the file is not there."""
    trunk = locate(FILES["lpips-alex"]) if config.lpips > 0 else None
    return [trunk] if isinstance(trunk, Path) else []
