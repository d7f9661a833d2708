"""OccGaussian, as the bench knows it before anything of it is imported."""

from __future__ import annotations

from ihbench.scene.method_spec import MethodSpec, Paper

PACKAGE = "ihbench.methods.occgaussian"
STATE = "gaussians"  # saved state

SPEC = MethodSpec(
    name="occgaussian",
    title="OccGaussian",
    summary="GauHuman whose hidden Gaussians ask the nearest seen ones for their features and colours; no diffusion",
    paper=Paper(
        title="OccGaussian: 3D Gaussian Splatting for Occluded Human Rendering",
        authors="Ye, Zhang, Liao",
        year=2025,
        code="none found; the arXiv version (2404.08449) was withdrawn",
        reported={"zju_mocap": {"psnr": 23.29, "ssim": 0.9482, "lpips_x1000": 41.93}},
    ),
    licence="Apache-2.0 (this code)",
    implemented="what the abstract says of it; every size, weight and number is inferred, and a switch",
    footnote="reimplementation, details inferred; the authors' row had five times the frames",
    method=f"{PACKAGE}.method:OccGaussian",
    profiles=f"{PACKAGE}.config:PROFILES",
    leave_out=f"{PACKAGE}.config:leave_out",
    outside_files=f"{PACKAGE}.config:outside_files",
    stress=f"{PACKAGE}.stress:CASES",
)
