"""OccNeRF, as the bench knows it before anything of it is imported."""

from __future__ import annotations

from ihbench.scene.method_spec import MethodSpec, Paper

PACKAGE = "ihbench.methods.occnerf"
STATE = "field"  # saved state

SPEC = MethodSpec(
    name="occnerf",
    title="OccNeRF",
    summary="a NeRF on features of the body's surface that little seen places borrow from others, solid inside the "
    "body; takes hidden pixels for background",
    paper=Paper(
        title="Rendering Humans from Object-Occluded Monocular Videos",
        authors="Xiang, Sun, Wu, Adeli, Fei-Fei",
        year=2023,
        code="https://github.com/tiangexiang/OccNeRF (read at 1cb1ef3; nothing of it is copied)",
        reported={"zju_mocap": {"psnr": 22.40, "ssim": 0.9562, "lpips_x1000": 43.01},
                  "ocmotion": {"psnr": 15.71, "ssim": 0.8230, "lpips_x1000": 82.90}},
    ),
    licence="Apache-2.0 (this code)",
    implemented="all that acts in the released code, from its behaviour; METHOD.md says what differs",
    method=f"{PACKAGE}.method:OccNerf",
    profiles=f"{PACKAGE}.config:PROFILES",
    outside_files=f"{PACKAGE}.config:outside_files",
    leave_out=f"{PACKAGE}.config:leave_out",
    stress=f"{PACKAGE}.stress:CASES",
)  # fmt: skip
