"""Stored values of every preset for one image pair, so that a metric and its oracle cannot drift together.

Made by `python -m tests.metrics.released`, which restates each released evaluator with the libraries it calls, in
float64, on `person_case(96, 80, dtype=np.uint8)`: scikit-image 0.26.0, torchmetrics 1.9.0, torch 2.14.1, numpy 2.4.
FLIP is the official evaluator's: flip_evaluator.evaluate(truth / 255, pred / 255, "LDR", applyMagma=False) in
float32, flip-evaluator 1.7. LPIPS has none: it needs weights that the bench may not ship.
"""

from __future__ import annotations

STORED: dict[str, dict[str, float]] = {
    "ihbench": {
        "flip/ldr-67ppd/srgb/full/v1": 0.10436218,
        "psnr/pooled/range1/full/v1": 21.022034304422842,
        "ssim/gauss11-1.5/range1/full/v1": 0.8724129224967476,
        "psnr/pooled/range1/box/v1": 18.040261789382058,
        "ssim/gauss11-1.5/range1/box/v1": 0.7860275192733791,
        "psnr/pooled/range1/body/v1": 18.917161818606235,
        "ssim/gauss11-1.5/range1/body/v1": 0.8733512806122518,
        "psnr/pooled/range1/visible/v1": 18.14286848892024,
        "ssim/gauss11-1.5/range1/visible/v1": 0.881133053701431,
        "psnr/pooled/range1/hidden/v1": 22.46452701817163,
        "ssim/gauss11-1.5/range1/hidden/v1": 0.9270182685971857,
        "psnr/pooled/range1/never_seen/v1": 16.28183652086576,
        "ssim/gauss11-1.5/range1/never_seen/v1": 0.8717506913657012,
    },
    "neuralbody": {
        "psnr/neuralbody-pooled/range1/box+0.05/v1": 18.040261789382058,
        "ssim/neuralbody-uniform7/range2/box+0.05/v1": 0.8308680712605528,
    },
    "humannerf": {
        "psnr/humannerf-pooled/range1/full/v1": 21.1605155890365,
        "ssim/humannerf-uniform7/range2/full/v1": 0.8898792938509154,
    },
    "occnerf": {
        "psnr/occnerf-pooled/range1/full/v1": 21.1605155890365,
        "ssim/occnerf-uniform7-map/range2/full/v1": 0.8898792938509154,
        "psnr/occnerf-pooled/range1/body/v1": 18.917161818606235,
        "ssim/occnerf-uniform7-map/range2/body/v1": 0.8484609592160567,
        "psnr/occnerf-pooled/range1/visible/v1": 18.14286848892024,
        "ssim/occnerf-uniform7-map/range2/visible/v1": 0.8313239382624517,
        "psnr/occnerf-pooled/range1/box+0.3/v1": 18.25745428631442,
        "ssim/occnerf-uniform7-map/range2/box+0.3/v1": 0.8129910013704771,
    },
    "gauhuman": {
        "psnr/gauhuman-channels/range1/full/v1": 21.170547927710533,
        "ssim/gauhuman-gauss11-zero/range1/full/v1": 0.8820883705191501,
    },
    "3dgs-avatar-zju": {
        "psnr/3dgs-avatar-zju-pooled/range1/full/v1": 21.022034304422842,
        "ssim/3dgs-avatar-zju-uniform7/range2/full/v1": 0.8892883069420922,
    },
    "instantavatar": {
        "psnr/instantavatar-pooled/range1/full/v1": 21.022034304422842,
        "ssim/instantavatar-gauss11-crop5/range1/full/v1": 0.8559678561062731,
        "ssim/instantavatar-gauss11/range1/full/v1": 0.8723887150143964,
    },
    "gtu-mask": {
        "psnr/gtu-mask-pooled/range1/body/v1": 18.917161818606232,
        "ssim/gtu-mask-gauss11-crop5/range1/body/v1": 0.8877594211804551,
    },
}
