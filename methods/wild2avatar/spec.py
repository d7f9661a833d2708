"""Wild2Avatar, as the bench knows it before anything of it is imported."""

from __future__ import annotations

from ihbench.scene.method_spec import MethodSpec, Paper

PACKAGE = "ihbench.methods.wild2avatar"
STATE = "fields"  # saved state

SPEC = MethodSpec(
    name="wild2avatar",
    title="Wild2Avatar",
    summary="a skinned signed distance field between a layer for what stands before the person and a background",
    paper=Paper(
        title="Rendering Humans Behind Occlusions",
        authors="Xiang, Sun, Delp, Kozuka, Fei-Fei, Adeli",
        year=2025,
        code="none released (tiangexiang/Wild2Avatar has a README); its base is MoyGcc/vid2avatar (read at 0d026ba; "
        "nothing of it is copied)",
        reported={"ocmotion": {"psnr": 14.09, "ssim": 0.8484, "lpips_x1000": 93.21}},
    ),
    licence="Apache-2.0 (this code)",
    implemented="the base from its released code's behaviour, the three parts from the project page; METHOD.md says "
    "what is inferred",
    footnote="reimplementation on Vid2Avatar; L_occ, L_comp inferred",
    needs=("images", "three-state masks", "cameras", "SMPL poses"),
    method=f"{PACKAGE}.method:Wild2Avatar",
    profiles=f"{PACKAGE}.config:PROFILES",
    leave_out=f"{PACKAGE}.config:leave_out",
    stress=f"{PACKAGE}.stress:CASES",
)  # fmt: skip
