"""InpaintHuman, as the bench knows it before anything of it is imported."""

from __future__ import annotations

from ihbench.scene.method_spec import Command, MethodSpec, Paper

PACKAGE = "ihbench.methods.inpainthuman"
STAGE1 = "stage1"  # saved state

SPEC = MethodSpec(
    name="inpainthuman",
    title="InpaintHuman",
    summary="UV feature maps 64/128/256 summed, decoded to Gaussians; what no frame shows is painted by personalised "
    "diffusion",
    paper=Paper(
        title="InpaintHuman: Reconstructing Occluded Humans with Multi-Scale UV Mapping and Identity-Preserving "
        "Diffusion Inpainting",
        authors="Fan, Zhao, Zheng, Zhang, Yang, Gong",
        year=2026,
        code="none released; this is a reimplementation from the paper's text",
        reported={
            "zju_mocap": {"psnr": 24.65, "ssim": 0.9614, "lpips_x1000": 31.63},
            "ocmotion": {"psnr": 19.02, "ssim": 0.8946, "lpips_x1000": 81.98},
        },
    ),
    licence="Apache-2.0 (this code)",
    implemented="all three stages, with a small diffusion backbone of our own or the user's Stable Diffusion 2 "
    "inpainting weights; METHOD.md says what differs from the paper",
    method=f"{PACKAGE}.method:InpaintHuman",
    profiles=f"{PACKAGE}.config:PROFILES",
    leave_out=f"{PACKAGE}.config:leave_out",
    outside_files=f"{PACKAGE}.config:outside_files",
    shared_states={STAGE1: ("inpaint.", "refine.")},
    ablations=f"{PACKAGE}.studies.ablations:SUITES",
    stress=f"{PACKAGE}.studies.stress:CASES",
    commands={
        "ceiling": Command(
            "what InpaintHuman's runs would have reached with a better painter, up to one that knows the truth",
            f"{PACKAGE}.studies.ceiling_command:main",
        ),
        "paint": Command(
            "how well InpaintHuman's painters fill hidden pixels, against the truth behind the occluder",
            f"{PACKAGE}.studies.paint_command:main",
        ),
    },
)
