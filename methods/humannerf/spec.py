"""HumanNeRF, as the bench knows it before anything of it is imported."""

from __future__ import annotations

from ihbench.scene.method_spec import MethodSpec, Paper

PACKAGE = "ihbench.methods.humannerf"
STATE = "avatar"  # saved state

SPEC = MethodSpec(
    name="humannerf",
    title="HumanNeRF",
    summary="a radiance field in the T-pose, seen through learned motion weights; takes hidden pixels for background",
    paper=Paper(
        title="HumanNeRF: Free-viewpoint Rendering of Moving People from Monocular Video",
        authors="Weng, Curless, Srinivasan, Barron, Kemelmacher-Shlizerman",
        year=2022,
        code="https://github.com/chungyiweng/humannerf (read at c753322; nothing of it is copied)",
        reported={
            "zju_mocap": {"psnr": 20.67, "ssim": 0.9509},
            "ocmotion": {"psnr": 9.79, "ssim": 0.7203, "lpips_x1000": 189.1},
        },
    ),
    licence="Apache-2.0 (this code)",
    implemented="all of it, from the released code's behaviour; METHOD.md says what differs",
    method=f"{PACKAGE}.method:HumanNerfMethod",
    profiles=f"{PACKAGE}.config:PROFILES",
    leave_out=f"{PACKAGE}.config:leave_out",
    outside_files=f"{PACKAGE}.config:outside_files",
    stress=f"{PACKAGE}.stress:CASES",
    kernels={"volume": f"{PACKAGE}.kernel:volume_rows"},
)
