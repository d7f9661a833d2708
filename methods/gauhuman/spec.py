"""GauHuman and OccGauHuman, as the bench knows them before anything of them is imported."""

from __future__ import annotations

from ihbench.scene.method_spec import MethodSpec, Paper

PACKAGE = "ihbench.methods.gauhuman"
STATE = "gaussians"  # saved state

SPEC = MethodSpec(
    name="gauhuman",
    title="GauHuman",
    summary="anisotropic Gaussians on the body's vertices, skinned, split and merged; takes hidden pixels for "
    "background",
    paper=Paper(
        title="GauHuman: Articulated Gaussian Splatting from Monocular Human Videos",
        authors="Hu, Hu, Liu",
        year=2024,
        code="https://github.com/skhu101/GauHuman (read at 732ec0d; nothing of it is copied)",
        reported={"zju_mocap": {"psnr": 21.55, "ssim": 0.9430, "lpips_x1000": 55.88},
                  "ocmotion": {"psnr": 15.09, "ssim": 0.8525, "lpips_x1000": 107.1}},
    ),
    licence="Apache-2.0 (this code)",
    implemented="all of it, from the released code's behaviour; METHOD.md says what differs",
    method=f"{PACKAGE}.method:GauHuman",
    profiles=f"{PACKAGE}.config:PROFILES",
    leave_out=f"{PACKAGE}.config:leave_out",
    outside_files=f"{PACKAGE}.config:outside_files",
    stress=f"{PACKAGE}.stress:CASES",
)  # fmt: skip

OCCGAUHUMAN = MethodSpec(
    name="occgauhuman",
    title="OccGauHuman",
    summary="GauHuman with colours from visible pixels alone, alpha held to a complete silhouette; OccFusion's base",
    paper=Paper(
        title="OccFusion: Rendering Occluded Humans with Generative Diffusion Priors",
        authors="Sun, Xiang, Delp, Fei-Fei, Adeli",
        year=2024,
        code="https://github.com/tiangexiang/OccFusion (read at f41e091; nothing of it is copied)",
    ),
    licence="Apache-2.0 (this code)",
    implemented="GauHuman here, with the losses of OccFusion's first stage; the complete silhouette is the posed "
    "body's where pixels are hidden",
    method=f"{PACKAGE}.method:GauHuman",
    profiles=f"{PACKAGE}.config:OCCGAUHUMAN_PROFILES",
    leave_out=f"{PACKAGE}.config:leave_out",
    outside_files=f"{PACKAGE}.config:outside_files",
    stress=f"{PACKAGE}.stress:OCCLUDED_CASES",
)
