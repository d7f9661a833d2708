"""GaussianAvatar, as the bench knows it before anything of it is imported."""

from __future__ import annotations

from ihbench.scene.method_spec import MethodSpec, Paper

PACKAGE = "ihbench.methods.gaussianavatar"
STAGE1, POSE_STAGE = "gaussianavatar-stage1", "gaussianavatar-stage2"  # saved states

SPEC = MethodSpec(
    name="gaussianavatar",
    title="GaussianAvatar",
    summary="one opaque Gaussian a UV texel, decoded from a smoothed feature map; hidden pixels are background to it",
    paper=Paper(
        title="GaussianAvatar: Towards Realistic Human Avatar Modeling from a Single Video via Animatable 3D "
        "Gaussians",
        authors="Hu, Zhang, Zhang, Zhou, Liu, Zhang, Nie",
        year=2024,
        code="aipixel/GaussianAvatar d981c62; this is a reimplementation, nothing is copied",
        reported={"zju_mocap": {"psnr": 18.01, "ssim": 0.9512, "lpips_x1000": 60.33}},  # InpaintHuman's Table 1
    ),
    licence="Apache-2.0 (this code)",
    implemented="stage 1, and stage 2 (pose features) as a switch; METHOD.md says what differs from the release",
    method=f"{PACKAGE}.method:GaussianAvatar",
    profiles=f"{PACKAGE}.config:PROFILES",
    leave_out=f"{PACKAGE}.config:leave_out",
    outside_files=f"{PACKAGE}.config:outside_files",
    shared_states={STAGE1: ("batch_norm", "pose_stage", "pose_steps", "pose_feature_weight", "network_rate_share")},
    stress=f"{PACKAGE}.stress:CASES",
)
