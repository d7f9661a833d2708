"""Every switch of Wild2Avatar. No code of it was released: what says Vid2Avatar is MoyGcc/vid2avatar at 0d026ba, its
base; what says inferred was chosen here, and METHOD.md gives the reason."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal

from ihbench.config_fields import STEPS, Within, check
from ihbench.errors import BadInput
from ihbench.scene.plan import Omission, SceneMeasure

WEIGHT, RATE = Within(0, 1e6), Within(0, 1000)  # of a term of the loss; a learning rate
STEP = Within(0, STEPS)
WIDTH, DEPTH = Within(8, 2048), Within(1, 16)
SAMPLES = Within(1, 1024)

STATIC_DEG = 5.0  # below this no joint moves, and what depends on the pose is a constant

# shares of a step's time, measured with the quick profile
OCCLUSION_SHARE = 0.1
BACKGROUND_SHARE = 0.1


@dataclass(frozen=True)
class Wild2AvatarConfig:
    occlusion: bool = True
    """The layer before the person. Without it this is Vid2Avatar with the term of completeness."""
    scene: Literal["network", "constant"] = "network"
    """What is behind the person: a network, or the protocol's colour."""
    steps: Annotated[int, Within(1, STEPS)] = 100_000
    """Optimisation steps, one training view each: 2000 epochs of 50 views. Vid2Avatar takes up to 8000."""
    rays: Annotated[int, Within(1, 1_000_000)] = 512
    """Rays of a step, 90 % of them in the window around the projected body (Vid2Avatar)."""
    # --- the person
    sdf_width: Annotated[int, WIDTH] = 256
    """Width of the signed distance network, and of the features it gives."""
    sdf_depth: Annotated[int, DEPTH] = 8
    """Its hidden layers."""
    sdf_skip: Annotated[int, Within(0, 16)] = 4
    """The layer that sees the encoded place again; 0 for none."""
    sdf_frequencies: Annotated[int, Within(0, 16)] = 6
    """Octaves of the encoding of places."""
    colour_width: Annotated[int, WIDTH] = 256
    """Width of the colour network."""
    colour_depth: Annotated[int, DEPTH] = 4
    """Its hidden layers."""
    pose_conditioning: bool = True
    """Shape and colour depend on the pose, but in the first epochs (`ramp_epochs` / 10) and in every 20th."""
    pose_at_test: Literal["all", "trained"] = "all"
    """Poses whose values shape and colour see when drawing: all, as in Vid2Avatar, or training frames' alone, so that
    no pair of a pose and a place is asked about that no image showed (Wild2Avatar's issue 2)."""
    beta: Annotated[float, Within(0, 10, above=True)] = 0.1
    """First β of the Laplace density in m; it is learned."""
    body_fit: Annotated[int, STEP] = 2000
    """Steps before the first in which the signed distance network is fitted to the body."""
    interval: Literal["spheres", "body"] = "spheres"
    """The part of a ray that may show the person: between both spheres as in the paper, or within .1 m of the posed
    body, beyond which nothing is drawn at test time either."""
    even_samples: Annotated[int, Within(2, 1024)] = 128
    """Even samples of a ray of the person, at which its distance is looked up first."""
    sample_rounds: Annotated[int, Within(0, 20)] = 5
    """Rounds of VolSDF's error-bounded sampling; 0: by the weights of the even samples."""
    samples_by_weight: Annotated[int, SAMPLES] = 64
    """Samples of a ray that are drawn by weight."""
    samples_extra: Annotated[int, Within(0, 1024)] = 32
    """Further ones of those looked up before."""
    least_weight: Annotated[float, Within(0, 1)] = 0.0
    """Samples whose weight is below this share of their ray's largest get neither colour nor gradient."""
    # --- before and behind
    scene_width: Annotated[int, WIDTH] = 256
    """Width of the network of occlusion and background."""
    scene_depth: Annotated[int, DEPTH] = 8
    """Its hidden layers."""
    scene_skip: Annotated[int, Within(0, 16)] = 4
    """The layer that sees the encoded place again; 0 for none."""
    scene_frequencies: Annotated[int, Within(0, 16)] = 10
    """Octaves of the encoding of inverted-sphere coordinates."""
    scene_samples: Annotated[int, SAMPLES] = 32
    """Samples of a ray in each of the two parts. Vid2Avatar's number for the background; the other is inferred."""
    # --- the loss
    colours: Annotated[float, WEIGHT] = 1.0
    """Weight of the mean absolute error of colours (L_rgb)."""
    eikonal: Annotated[float, WEIGHT] = 0.1
    """Weight of the eikonal term (L_eik)."""
    eikonal_points: Annotated[int, Within(1, 1_000_000)] = 512
    """Canonical vertices, moved by N(0, .01 m), at which it is taken."""
    entropy: Annotated[float, WEIGHT] = 0.005
    """Weight of the entropy of the person's alpha, part of L_dec (Vid2Avatar)."""
    beside: Annotated[float, WEIGHT] = 0.003
    """Weight of the person's alpha on rays beside the body, part of L_dec (Vid2Avatar). It is multiplied by 1 + e²/40
    with e the epoch, counted to 200 in `ramp_epochs`."""
    inside: Annotated[float, WEIGHT] = 0.0
    """Weight of 1 - alpha on rays that hit the body, fading with e. Vid2Avatar's own is .01; the term of completeness
    has its place."""
    completeness: Annotated[float, WEIGHT] = 0.1
    """Weight of -log of the person's alpha on rays that hit the body or show visible person (L_comp) [inferred]."""
    background_alpha: Annotated[float, WEIGHT] = 0.1
    """Weight of -log(1 - alpha) of the person on background, known or beside a seen part of the body [inferred:
    without it the distance field takes up a plain background; Vid2Avatar's issue 45]."""
    around: Annotated[float, WEIGHT] = 0.005
    """Weight of the person's alpha on unknown pixels beside the posed body [inferred]."""
    occlusion_loss: Annotated[float, WEIGHT] = 1.0
    """Weight of L_occ: -log(1 - A) of the layer on visible person, -log A where the body is hidden [inferred]."""
    layer_over: Literal["all", "unknown"] = "all"
    """Pixels whose colour is that of all layers together: all, or those alone whose mask does not say person or
    background. Where it does, no occluder stands, and as long as the layer does the person is fitted darker or
    lighter than it is, in short fits until it is black or white and has no gradient left."""
    sparsity: Annotated[float, WEIGHT] = 0.01
    """Weight of the layer's alpha elsewhere, part of L_occ [inferred]."""
    ramp_epochs: Annotated[float, Within(0, STEPS, above=True)] = 200.0
    """Epochs over which `beside` grows and `inside` fades."""
    refresh_epochs: Annotated[int, Within(1, STEPS)] = 20
    """Epochs between two looks at the surface that rays pass beside (Vid2Avatar)."""
    # --- the optimiser
    refine_poses: bool = True
    """Fit the training frames' poses, translations and one shape. Never those of test views."""
    lr: Annotated[float, RATE] = 5e-4
    """Adam's step size of the networks of colour, occlusion and background."""
    lr_sdf: Annotated[float, RATE] = 5e-4
    """Adam's step size of the signed distance network."""
    lr_beta: Annotated[float, RATE] = 5e-4
    """Adam's step size of β."""
    lr_poses: Annotated[float, RATE] = 5e-5
    """Adam's step size of poses, translations and shape."""
    decay: Literal["halves", "cosine"] = "halves"
    """Step sizes halve at epochs 200 and 500 (Vid2Avatar), or fall to a twentieth as half a cosine."""
    warm_up: Annotated[float, Within(0, 1)] = 0.0
    """Share of the steps over which step sizes rise: Adam's first steps are a whole rate each."""
    clip: Annotated[float, Within(0, 1e9, above=True)] = 1e9
    """Largest norm of the gradient of each group of parameters. Vid2Avatar has none."""

    def __post_init__(self) -> None:
        check(self, "--method.")
        encoded = 3 + 6 * self.sdf_frequencies
        if 0 < self.sdf_skip < self.sdf_depth and self.sdf_width <= encoded:
            raise BadInput(
                f"--method.sdf-width: expected more than the {encoded} values of an encoded place, which enter again "
                f"at --method.sdf-skip {self.sdf_skip}, got {self.sdf_width}"
            )


PAPER = Wild2AvatarConfig()
QUICK = replace(
    PAPER,
    steps=2000,
    rays=128,
    sdf_width=64,
    sdf_depth=4,
    sdf_skip=0,
    colour_width=64,
    colour_depth=2,
    pose_conditioning=False,
    beta=0.02,
    body_fit=600,
    interval="body",
    even_samples=24,
    sample_rounds=0,
    samples_by_weight=10,
    samples_extra=4,
    least_weight=1e-3,
    scene_width=64,
    scene_depth=3,
    scene_skip=0,
    scene_samples=8,
    layer_over="unknown",
    eikonal_points=128,
    ramp_epochs=20.0,
    refresh_epochs=10,
    refine_poses=False,
    lr=3e-3,
    lr_beta=5e-5,
    decay="cosine",
    warm_up=0.02,
    clip=1.0,
)
SMOKE = replace(QUICK, steps=60, rays=96, sdf_width=48, sdf_depth=3, body_fit=150, lr=1e-2, lr_beta=2e-4, warm_up=0.1)

PROFILES = {"smoke": SMOKE, "quick": QUICK, "paper": PAPER}


def leave_out(config: Wild2AvatarConfig, scene: SceneMeasure) -> list[Omission]:
    """What this scene does not need of this configuration (see `ihbench.scene.plan`)."""
    out = []
    if config.occlusion and scene.hidden_share == 0:
        reason = "nothing is hidden: there is no occluder to explain"
        out.append(Omission("occlusion", False, reason, {"fit/fields": OCCLUSION_SHARE}))
    if config.scene == "network" and not scene.in_scene:
        reason = "known background has one colour, the protocol's"
        out.append(Omission("scene", "constant", reason, {"fit/fields": BACKGROUND_SHARE}))
    if config.pose_conditioning and scene.motion_deg < STATIC_DEG:
        reason = f"no joint turns more than {scene.motion_deg:.1f}° over the training frames (limit {STATIC_DEG}°)"
        out.append(Omission("pose_conditioning", False, reason))
    return out
