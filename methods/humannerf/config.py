"""Every switch of HumanNeRF, with the value of the released code (chungyiweng/humannerf c753322, ZJU-MoCap).

Steps count from 1. `paper` is as released; `quick` and `smoke` are the same system and order of events, smaller and
in fewer steps.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from ihbench.config_fields import STEPS, Within, check
from ihbench.metrics.weights import FILES, locate
from ihbench.scene.plan import Omission, SceneMeasure

WEIGHT, RATE = Within(0, 1e6), Within(0, 1000)  # of a term of the loss; a learning rate
STEP = Within(0, STEPS)
RELEASED_STEPS = 400_000
EARLY = 25  # steps after which a fit on a CPU shows something, if it ever will
STATIC_DEG = 5.0  # below this no joint moves, and an offset that depends on the pose is a constant

# share of a step's time, measured with the quick profile
NON_RIGID_SHARE = 0.1


@dataclass(frozen=True)
class HumanNerfConfig:
    unknown: Literal["background", "ignore"] = "background"
    """What a hidden pixel is taken for. As released, which knows two states: background, in a new colour each step,
    so the occluder makes the person transparent. With ignore hidden pixels are compared with nothing, and no patch
    has its middle there: a stronger method than the published one."""
    steps: Annotated[int, Within(1, STEPS)] = RELEASED_STEPS
    """Optimisation steps, one training view each."""
    depth: Annotated[int, Within(3, 32)] = 8
    """Hidden layers of the canonical network; the encoding comes in again at the third last."""
    width: Annotated[int, Within(4, 4096)] = 256
    """Their width."""
    bands: Annotated[int, Within(0, 16)] = 10
    """Octaves of the positional encoding of canonical places, from 1 rad/m."""
    non_rigid: bool = True
    """Move canonical places by a network of the pose."""
    non_rigid_depth: Annotated[int, Within(2, 32)] = 6
    """Its hidden layers; the encoding comes in again at the second last."""
    non_rigid_width: Annotated[int, Within(4, 4096)] = 128
    """Their width."""
    non_rigid_bands: Annotated[int, Within(1, 16)] = 6
    """Octaves of its positional encoding. They come on one after the other."""
    kick_in: Annotated[int, STEP] = 10_000
    """The last step before the non-rigid network sees a place or a pose: until then it is one global offset."""
    full_band: Annotated[int, STEP] = 50_000
    """The step from which all its octaves are on."""
    refine_poses: bool = True
    """Correct joint rotations by a network of the pose."""
    poses_from: Annotated[int, STEP] = 1
    """The first step that does: 1 as released for ZJU-MoCap, 20000 for films from the wild."""
    test_poses: Literal["released", "given"] = "released"
    """As released, the correction is a function of the pose and acts on every pose that is drawn; given: on none."""
    pose_depth: Annotated[int, Within(1, 32)] = 4
    """Hidden layers of the network that corrects poses."""
    pose_width: Annotated[int, Within(4, 4096)] = 256
    """Their width."""
    weight_code: Annotated[int, Within(1, 4096)] = 256
    """Numbers of the learned vector that the motion weights are decoded from."""
    weight_channels: Annotated[int, Within(8, 4096)] = 1024
    """Channels of their decoder's first layer; a half, a half, a quarter and a quarter in the next ones."""
    box_margin: Annotated[float, Within(0.05, 5)] = 0.3
    """Metres around the joints, of the canonical lattice and of the box that rays are followed in."""
    samples: Annotated[int, Within(2, 4096)] = 128
    """Samples of a ray in the box."""
    inside: Annotated[int, Within(0, 4096)] = 0
    """While fitting, samples of a second pass between the first and the last of them that is not empty; 0: none."""
    least: Annotated[float, Within(0, 1)] = 1e-3
    """Samples less likely than this to be of the person are empty and no network sees them. A pixel is off by at most
    their sum; 0 as released."""
    least_weight: Annotated[float, Within(0, 1)] = 1e-4
    """A bone is asked only inside the box beyond which its weights are all under this; 0 as released."""
    stop: Annotated[float, Within(0, 1)] = 1e-3
    """When drawing, rays that let through less than this are done; 0 as released."""
    clamp: bool = True
    """Hold likelihoods at 1 or under: where two limbs are close they sum to more, and a ray would let through a
    negative share. Not so in the released code."""
    patches: Annotated[int, Within(1, 1024)] = 6
    """Patches of a step, all of one view."""
    patch_px: Annotated[int, Within(4, 1024)] = 32
    """Their side."""
    on_person: Annotated[float, Within(0, 1)] = 0.8
    """Share of the patches whose middle is a visible person pixel; the others' is background in the box."""
    lpips: Annotated[float, WEIGHT] = 1.0
    """Weight of the perceptual distance of patches: LPIPS where its trunk's weights are, else `without_lpips`."""
    lpips_net: Literal["vgg", "alex", "squeeze"] = "vgg"
    """Trunk of LPIPS."""
    without_lpips: Literal["pyramid", "none"] = "pyramid"
    """What takes its place where the weights are missing, and the record says so: absolute differences over bands of
    a pyramid, or nothing."""
    mse: Annotated[float, WEIGHT] = 0.2
    """Weight of the mean squared error of patches."""
    lr: Annotated[float, RATE] = 5e-4
    """Adam's step size of the canonical network. Step sizes fall exponentially, to a tenth over `decay_steps`."""
    lr_motion: Annotated[float, RATE] = 5e-5
    """Adam's step size of the decoder of motion weights."""
    lr_non_rigid: Annotated[float, RATE] = 5e-5
    """Adam's step size of the non-rigid network."""
    lr_poses: Annotated[float, RATE] = 5e-5
    """Adam's step size of the network that corrects poses."""
    decay_steps: Annotated[int, Within(1, 100 * STEPS)] = 500_000
    """See `lr`."""
    first_density: Annotated[float, Within(0, 1000)] = 0.0
    """First bias of the density before its law, in 1/m. With 0, as released, first weights decide by chance whether
    there is any density, and one step may be enough to lose it."""
    warm_up: Annotated[int, STEP] = 0
    """Steps over which all step sizes rise to their own; 0 as released."""
    squared_first: Annotated[int, STEP] = 0
    """Steps by squared error alone; over as many more the perceptual distance's weight rises to its own. 0 as
    released."""
    guard: tuple[int, ...] = (100, 300, 1000, 2500, 5000)
    """Steps after which the fit starts again from other first weights where one of 16 pictures shows nothing."""

    def __post_init__(self) -> None:
        check(self, "--method.")


def in_steps(config: HumanNerfConfig, steps: int) -> HumanNerfConfig:
    """The schedule of a configuration in other steps, events at the same shares of them; the guard looks after a
    sixth, a third and two thirds, and early in a long fit: one that starts empty stays so."""
    share = steps / config.steps

    def scaled(step: int) -> int:
        return round(step * share)

    return replace(
        config,
        steps=steps,
        kick_in=scaled(config.kick_in),
        full_band=scaled(config.full_band),
        decay_steps=max(scaled(config.decay_steps), 1),
        warm_up=scaled(config.warm_up),
        squared_first=scaled(config.squared_first),
        guard=((EARLY,) if steps // 6 > EARLY else ()) + (steps // 6, steps // 3, 2 * steps // 3),
    )


ON_A_CPU = HumanNerfConfig(
    depth=6,
    width=128,
    bands=8,
    non_rigid_depth=4,
    non_rigid_width=64,
    pose_depth=2,
    pose_width=128,
    weight_code=64,
    weight_channels=128,
    samples=64,
    least=1e-2,
    patches=2,
    lr=3e-3,
    lr_motion=3e-3,
    lr_non_rigid=5e-4,
    lr_poses=2e-4,
    first_density=5.0,
)

PAPER = HumanNerfConfig()
QUICK = replace(in_steps(ON_A_CPU, 400), steps=600, warm_up=50, squared_first=50)
SMOKE = replace(
    in_steps(ON_A_CPU, 40),
    depth=4,
    width=64,
    bands=6,
    non_rigid_width=32,
    weight_code=16,
    weight_channels=32,
    samples=48,
    patch_px=16,
    lr=5e-3,
    lr_motion=5e-3,
    warm_up=5,
    squared_first=5,
)

PROFILES = {"smoke": SMOKE, "quick": QUICK, "paper": PAPER}


def leave_out(config: HumanNerfConfig, scene: SceneMeasure) -> list[Omission]:
    """What this scene does not need of this configuration (see `ihbench.scene.plan`)."""
    if not config.non_rigid or scene.motion_deg >= STATIC_DEG:
        return []
    reason = f"no joint turns more than {scene.motion_deg:.1f}° over the training frames (limit {STATIC_DEG}°)"
    return [Omission("non_rigid", False, reason, {"fit/field": NON_RIGID_SHARE})]


def outside_files(config: HumanNerfConfig) -> list[Path]:
    """Files whose content affects the answer: the trunk of LPIPS, in whose place another distance stands."""
    trunk = locate(FILES[f"lpips-{config.lpips_net}"]) if config.lpips > 0 else None
    return [trunk] if isinstance(trunk, Path) else []
