"""3DGS-Avatar, as the bench knows it before anything of it is imported."""

from __future__ import annotations

from ihbench.scene.method_spec import MethodSpec, Paper

PACKAGE = "ihbench.methods.three_dgs_avatar"
STATE = "avatar"  # saved state

SPEC = MethodSpec(
    name="three-dgs-avatar",
    title="3DGS-Avatar",
    summary="Gaussians moved by a hash grid and a learned skinning field, coloured by a network; takes hidden pixels "
    "for background",
    paper=Paper(
        title="3DGS-Avatar: Animatable Avatars via Deformable 3D Gaussian Splatting",
        authors="Qian, Wang, Mihajlovic, Geiger, Tang",
        year=2024,
        code="https://github.com/mikeqzy/3dgs-avatar-release (read at fc39bc5; nothing of it is copied)",
        reported={"zju_mocap": {"psnr": 17.29, "ssim": 0.9410, "lpips_x1000": 63.25}},
    ),
    licence="Apache-2.0 (this code)",
    implemented="all of it, from the released code's behaviour; METHOD.md says what differs",
    method=f"{PACKAGE}.method:ThreeDgsAvatarMethod",
    profiles=f"{PACKAGE}.config:PROFILES",
    leave_out=f"{PACKAGE}.config:leave_out",
    outside_files=f"{PACKAGE}.config:outside_files",
    stress=f"{PACKAGE}.stress:CASES",
)
