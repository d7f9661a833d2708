"""GTU, as the bench knows it before anything of it is imported."""

from __future__ import annotations

from ihbench.scene.method_spec import MethodSpec, Paper

PACKAGE = "ihbench.methods.gtu"
STATE, IDENTITY = "gtu-gaussians", "gtu-identity"  # saved states

SPEC = MethodSpec(
    name="gtu",
    title="GTU",
    summary="Gaussians on the body's vertices; what no photo shows is guessed by score distillation from a diffusion "
    "model tuned to the person",
    paper=Paper(
        title="Guess The Unseen: Dynamic 3D Scene Reconstruction from Partial 2D Glimpses",
        authors="Lee, Kim, Joo",
        year=2024,
        code="https://github.com/snuvclab/gtu (read at 6b3026c; nothing of it is copied)",
        reported={"zju_mocap": {"psnr": 22.89, "ssim": 0.9503, "lpips_x1000": 40.78},
                  "ocmotion": {"psnr": 15.83, "ssim": 0.8437, "lpips_x1000": 83.46}},
    ),
    licence="Apache-2.0 (this code)",
    implemented="one person, no background, with a small diffusion backbone of our own or the user's own Stable "
    "Diffusion 2 inpainting weights; METHOD.md says what differs",
    method=f"{PACKAGE}.method:Gtu",
    profiles=f"{PACKAGE}.config:PROFILES",
    leave_out=f"{PACKAGE}.config:leave_out",
    outside_files=f"{PACKAGE}.config:outside_files",
    stress=f"{PACKAGE}.stress:CASES",
)  # fmt: skip
