"""Every switch of stage 2 (`--method.inpaint.*`). Section numbers are the paper's."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal, get_args

from ihbench.config_fields import STEPS, Within, check
from ihbench.errors import BadInput

TOKEN = "<someone>"
Filler = Literal[
    "diffusion", "mean", "telea", "navier-stokes", "shift-map", "fsr", "biharmonic", "push-pull", "mirror", "temporal"
]  # fmt: skip
SIMPLE = get_args(Filler)[1:]
# rows of `ihbench paint` -> which of ti, lora and sg are on
COMPONENTS: dict[str, tuple[bool, bool, bool]] = {
    "generic": (False, False, False),
    "generic+sg": (False, False, True),
    "ti": (True, False, False),
    "ti+sg": (True, False, True),
    "lora+sg": (False, True, True),
    "ti+lora": (True, True, False),
    "ti+lora+sg": (True, True, True),
}
FULL = "ti+lora+sg"


@dataclass(frozen=True)
class Settled:
    """The fields of `InpaintConfig` that depend on the backbone."""

    vectors: int
    ti_lr: float
    tune: Literal["lora", "all"]
    lora_lr: float
    control_lr: float
    sampler_steps: int
    noise: float
    guidance: float


@dataclass(frozen=True)
class InpaintConfig:
    on: bool = True
    """Stages 2 and 3. Off: stage 1 alone."""
    always: bool = False
    """Personalise the painter also where nothing needs painting, as the paper's text has it. Only good for measuring
    what leaving that out saves."""
    filler: Filler = "diffusion"
    """What paints hidden pixels: the paper's diffusion model, or one of the simple fills beside it in tables."""
    backbone: Literal["mini", "sd2"] = "mini"
    """The diffusion model: the small one that comes with the bench, or your own Stable Diffusion 2 inpainting."""
    weights: str = ""
    """Folder (diffusers layout, safetensors) or hub id of the weights. sd2 needs it; empty gives the shipped mini."""
    control_weights: str = ""
    """sd2: folder of a ControlNet for the part map, or of the 4-channel base UNet to make one from; empty makes one
    from the inpainting UNet."""
    ti: bool = True
    """Textual inversion: learn a word for the person from the best-seen frames (sec. 3.3)."""
    lora: bool = True
    """Adapt the UNet to the person by painting visible pixels that were hidden on purpose (sec. 3.3)."""
    sg: bool = True
    """Semantic guidance: the ControlNet on the body's part map, adapted together with the UNet (sec. 3.3). Wherever
    the model is asked, also while the word is learned."""
    token: str = TOKEN
    """The new word V*."""
    vectors: Annotated[int | None, Within(1, 64)] = None
    """Word vectors of V*. None: 4 for mini, which was trained with so many; 1 for sd2, as in the paper."""
    ti_steps: Annotated[int, Within(1, STEPS)] = 80
    """Steps of textual inversion."""
    ti_lr: Annotated[float | None, Within(0, 1000, above=True)] = None
    """AdamW step size of the word vectors. None: 2e-2 for mini; 5e-4 for sd2, as in diffusers' recipe."""
    ti_frames: Annotated[float, Within(0, 1, above=True)] = 0.2
    """Share of the frames, the best seen, that textual inversion learns from."""
    text_lora: bool = False
    """Adapt the text encoder by LoRA during textual inversion, the paper's "jointly fine-tune"."""
    lora_steps: Annotated[int, Within(1, STEPS)] = 100
    """Steps of the adaptation."""
    tune: Literal["lora", "all"] | None = None
    """What the adaptation changes in the UNet: LoRA on its attention (the paper), or every weight. None: all for
    mini, which gains more from it; lora for sd2."""
    rank: Annotated[int, Within(1, 1024)] = 8
    """Rank of LoRA, and its alpha (sec. 4.2)."""
    lora_lr: Annotated[float | None, Within(0, 1000, above=True)] = None
    """AdamW step size of LoRA, or of every weight. None: 1e-4 for sd2, for mini 3e-4 (1e-3 with LoRA)."""
    control_lr: Annotated[float | None, Within(0, 1000, above=True)] = None
    """AdamW step size of the ControlNet. None: 3e-4 for mini, 1e-5 for sd2."""
    batch: Annotated[int, Within(1, 4096)] = 8
    """Crops a step, halved when memory runs out."""
    sampler_steps: Annotated[int | None, Within(1, 1000)] = None
    """DDIM steps. None: 6 for mini, 50 for sd2."""
    noise: Annotated[float | None, Within(0, 100)] = None
    """Scale of the noise that sampling starts from. None: 1 for sd2; 0 for mini, whose colours follow strong noise:
    its mean answer is the better one."""
    guidance: Annotated[float | None, Within(1, 1000)] = None
    """Classifier-free guidance against the empty prompt; 1 is none. None: 1 for mini, 5 for sd2."""
    context: Literal["seen", "frame"] = "seen"
    """What the inpainter is shown besides visible pixels. "seen": hidden pixels whose surface another frame shows are
    drawn by the stage-1 avatar, and only what no frame shows is painted. "frame": the frame alone, as the paper."""
    trust: Annotated[float, Within(0, 1)] = 0.4
    """Weight of the painter's colours; the rest is the stage-1 avatar's own guess, which errs differently. 1: the
    painter alone (the paper). With context "seen" only."""
    facing: Annotated[float, Within(0, 0.999)] = 0.0
    """Only surface is painted that faces some training view, hidden, by at least this cosine; what all views would
    see at a glancing angle keeps stage 1's colours. 0: all of it (the paper). The plan takes 0.5 where the person
    turns only in part; where they turn fully that is worse. With context "seen"."""
    key_views: Annotated[int, Within(0, 100_000)] = 40
    """Frames painted at most, chosen to see all of the surface that needs it; 0 for every frame that sees some."""
    turntable: Annotated[int, Within(0, 10_000)] = 0
    """Views of the stage-1 avatar, all around it, inpainted too: the only way to surface that never faced the camera.
    A departure from the paper; needs context "seen"."""
    heads: bool | None = False
    """Paint hidden heads once more, at twice the scale, beginning with what was painted of the person. None, as in
    `ihbench paint`: where the backbone has learned heads, as the mini that comes with the bench has, and sd2 has not.
    Off in runs: painters gain a face, avatars lose the outline of their hair. Never without `sg`."""
    heads_trust: Annotated[float, Within(0, 1)] = 0.7
    """As `trust`, of heads painted once more."""
    silhouette: Literal["coverage", "grabcut", "sam"] = "coverage"
    """What finds the complete silhouette in a painted frame: half of the way from the background's colour to the
    person's, GrabCut, or HQ-SAM (the paper's)."""
    sam_weights: str = ""
    """Folder of HQ-SAM weights in transformers' layout, for silhouette "sam"."""
    memory_lean: bool = False
    """sd2: checkpointed gradients, the autoencoder in slices and tiles: less memory, more time."""

    def __post_init__(self) -> None:
        check(self, "--method.inpaint.")
        rules = (
            (
                "turntable",
                not self.turntable or self.context == "seen",
                '0 unless --method.inpaint.context is "seen"',
            ),
            ("token", bool(self.token.strip()) and " " not in self.token, "one word"),
            ("sam_weights", not self.on or self.silhouette != "sam" or bool(self.sam_weights), SAM_WANTED),
            ("weights", self.backbone != "sd2" or not self.uses_diffusion or bool(self.weights), SD2_WANTED),
        )
        for name, holds, expected in rules:
            if not holds:
                raise BadInput(
                    f"--method.inpaint.{name.replace('_', '-')} {getattr(self, name)!r}: expected {expected}"
                )

    def settled(self) -> Settled:
        """The values that are in force, with the backbone's own in the place of None."""
        own = OWN[self.backbone]
        if self.backbone == "mini" and self.tune == "lora":
            own = replace(own, lora_lr=LORA_OF_MINI)
        given = {name: getattr(self, name) for name in vars(own) if getattr(self, name) is not None}
        return replace(own, **given)

    @property
    def uses_diffusion(self) -> bool:
        return self.on and self.filler == "diffusion"

    @property
    def names_something(self) -> bool:
        """Whether the user has named what may be wrong: weights, or a word."""
        return bool(self.weights or self.control_weights) or self.token != TOKEN


SAM_WANTED = "the folder of HQ-SAM in transformers' layout, which silhouette sam needs"
SD2_WANTED = (
    "the folder of Stable Diffusion 2 inpainting (diffusers layout: unet/ vae/ text_encoder/ tokenizer/ scheduler/, "
    "safetensors), which backbone sd2 needs"
)

# what a field that is None means
OWN = {
    "mini": Settled(
        vectors=4, ti_lr=2e-2, tune="all", lora_lr=3e-4, control_lr=3e-4, sampler_steps=6, noise=0.0, guidance=1.0
    ),
    "sd2": Settled(
        vectors=1, ti_lr=5e-4, tune="lora", lora_lr=1e-4, control_lr=1e-5, sampler_steps=50, noise=1.0, guidance=5.0
    ),
}
LORA_OF_MINI = 1e-3  # step size: so few weights need longer steps

QUICK_INPAINT = InpaintConfig()
PAPER_INPAINT = InpaintConfig(ti_steps=1000, lora_steps=2000, trust=1.0, heads_trust=1.0, key_views=0)
