"""OccFusion, as the bench knows it before anything of it is imported."""

from __future__ import annotations

from ihbench.scene.method_spec import MethodSpec, Paper

PACKAGE = "ihbench.methods.occfusion"
MASKS, MASKS_SAMPLED = "stage0-masks", "stage0-sampled"  # saved states
STAGE1, STAGE3 = "occfusion-stage1", "occfusion-stage3"
GENERATED, GENERATED_SAMPLED = "stage2-generated", "stage2-sampled"

SPEC = MethodSpec(
    name="occfusion",
    title="OccFusion",
    summary="GauHuman's Gaussians; silhouettes are completed by inpainting, alpha is guided by score distillation, "
    "hidden colours come from in-context inpainting",
    paper=Paper(
        title="OccFusion: Rendering Occluded Humans with Generative Diffusion Priors",
        authors="Sun, Xiang, Delp, Fei-Fei, Adeli",
        year=2024,
        code="https://github.com/tiangexiang/OccFusion (read at f41e091; nothing of it is copied)",
        reported={"zju_mocap": {"psnr": 23.96, "ssim": 0.9548, "lpips_x1000": 32.34},
                  "ocmotion": {"psnr": 18.28, "ssim": 0.8805, "lpips_x1000": 82.42}},
    ),
    licence="Apache-2.0 (this code)",
    implemented="all four stages, from the released code's behaviour, with a small diffusion backbone of our own or "
    "the user's Stable Diffusion 2 inpainting weights; METHOD.md says what differs",
    method=f"{PACKAGE}.method:OccFusion",
    profiles=f"{PACKAGE}.config:PROFILES",
    leave_out=f"{PACKAGE}.config:leave_out",
    outside_files=f"{PACKAGE}.config:outside_files",
    stress=f"{PACKAGE}.stress:CASES",
)  # fmt: skip
