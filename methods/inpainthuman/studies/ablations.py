"""Ablations of InpaintHuman: the paper's Table 2 in both readings, and sweeps that the paper lacks."""

from __future__ import annotations

from ihbench.config_fields import Values
from ihbench.runner.ablation import AblationSuite, Comparison, Variant

ONE_LEVEL: Values = {"levels": (128,)}  # the paper does not say which single map its baseline has
NO_PAINTER: Values = {"inpaint.on": False}
ONE_FIT: Values = {"one_fit": True}  # what a fit with more steps reaches without paintings
NO_PRIOR: Values = {"prior.color": 0.0, "prior.offset": 0.0, "prior.scale": 0.0}
# what is left out everywhere, besides what the plan leaves out of a scene
EVERYTHING: Values = {"cull": False, "crop": False, "inpaint.key_views": 0, "inpaint.always": True}
NEITHER: Values = {"inpaint.ti": False, "inpaint.sg": False}


def _paper(psnr: float, ssim: float, lpips: float) -> dict[str, float]:
    return {"psnr": psnr, "ssim": ssim, "lpips": lpips}


ROWS = (
    _paper(20.05, 0.9501, 61.47),
    _paper(22.35, 0.9603, 55.92),
    _paper(24.27, 0.9649, 38.53),
    _paper(24.31, 0.9701, 37.42),
)


def _levels(*sides: int) -> Variant:
    return Variant("+".join(map(str, sides)), {"levels": sides, **NO_PAINTER})


SUITES = {
    "table2": AblationSuite(
        "the paper's Table 2, in both readings of its first two rows",
        (
            Variant("one level", ONE_LEVEL | NO_PAINTER, ROWS[0]),
            Variant("MS", NO_PAINTER, ROWS[1]),
            Variant("MS, one fit", ONE_FIT),
            Variant("one level, diffusion", ONE_LEVEL | NEITHER, ROWS[0]),
            Variant("MS, diffusion", NEITHER, ROWS[1]),
            Variant("MS + TI", {"inpaint.sg": False}, ROWS[2]),
            Variant("MS + TI + SG", {}, ROWS[3]),
        ),
        (
            Comparison("multi-scale maps", "one level", "MS"),
            Comparison("multi-scale maps, with diffusion", "one level, diffusion", "MS, diffusion"),
            Comparison("more steps", "MS", "MS, one fit"),
            Comparison("diffusion without a word", "MS", "MS, diffusion"),
            Comparison("the word V* (TI)", "MS, diffusion", "MS + TI"),
            Comparison("diffusion and the word", "MS", "MS + TI"),
            Comparison("semantic guidance (SG)", "MS + TI", "MS + TI + SG"),
            Comparison("everything", "one level", "MS + TI + SG"),
        ),
        "The paper does not say whether diffusion is off in its first two rows or on without the word; the paper's "
        "numbers stand beside both.",
    ),
    "plan": AblationSuite(
        "everything (hidden Gaussians, whole images, needless key views), against what the plan leaves for a scene",
        (Variant("everything", EVERYTHING, keep=("all",)), Variant("planned")),
        (Comparison("leaving out what the scene does not need", "everything", "planned"),),
    ),
    "levels": AblationSuite(
        "levels of the UV feature maps, stage 1 alone",
        (_levels(64), _levels(64, 128), _levels(64, 128, 256), _levels(128), _levels(256)),
        (
            Comparison("a level of 128", "64", "64+128"),
            Comparison("a level of 256", "64+128", "64+128+256"),
            Comparison("three levels instead of 128", "128", "64+128+256"),
            Comparison("three levels instead of 256", "256", "64+128+256"),
        ),
    ),
    "fusion": AblationSuite(
        "how levels are joined, stage 1 alone",
        (Variant("sum", NO_PAINTER), Variant("concat", {"fusion": "concat", **NO_PAINTER})),
        (Comparison("concatenation instead of the sum", "sum", "concat"),),
    ),
    "residual": AblationSuite(
        "the pose-dependent residual, stage 1 alone",
        (Variant("without", {"pose_residual": False, **NO_PAINTER}), Variant("with", NO_PAINTER)),
        (Comparison("the pose residual", "without", "with"),),
    ),
    "prior": AblationSuite(
        "the smoothness prior, stage 1 alone",
        (Variant("without", NO_PRIOR | NO_PAINTER), Variant("with", NO_PAINTER)),
        (Comparison("the smoothness prior", "without", "with"),),
    ),
    "rim": AblationSuite(
        "background beside an occluder, stage 1 alone",
        (Variant("learned", {"background_rim": 0.0} | NO_PAINTER), Variant("left out", NO_PAINTER)),
        (Comparison("no background beside an occluder", "learned", "left out"),),
    ),
    "rank": AblationSuite(
        "rank of LoRA on the painter",
        (
            *(Variant(f"rank {r}", {"inpaint.tune": "lora", "inpaint.rank": r}) for r in (2, 8, 32)),
            Variant("every weight", {"inpaint.tune": "all"}),
        ),
        (
            Comparison("rank 8 instead of 2", "rank 2", "rank 8"),
            Comparison("rank 32 instead of 8", "rank 8", "rank 32"),
            Comparison("every weight instead of rank 8", "rank 8", "every weight"),
        ),
    ),
    "painter": AblationSuite(
        "what paints hidden surface",
        (
            Variant("nothing", NO_PAINTER),
            *(Variant(name, {"inpaint.filler": name}) for name in ("push-pull", "mirror", "temporal")),
            Variant("diffusion", {}),
        ),
        tuple(
            Comparison(f"diffusion instead of {name}", name, "diffusion")
            for name in ("nothing", "push-pull", "mirror", "temporal")
        ),
    ),
}  # fmt: skip
