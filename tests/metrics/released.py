"""The released evaluators restated with the libraries they call: independent of everything under `ihbench/metrics`.

`python -m tests.metrics.released` prints the numbers that `ihbench/metrics/oracles/reference_values.py` holds.
"""

from __future__ import annotations

import math

import numpy as np
import torch
import torch.nn.functional as F
from skimage.metrics import structural_similarity
from torchmetrics.functional.image import structural_similarity_index_measure


def decibels(x, y):
    return -10 * math.log10(np.mean((x - y) ** 2))


def unit(image):
    return image / 255.0 if image.dtype == np.uint8 else image.astype(np.float64)


def paint(image, mask, value):
    out = image.copy()
    out[~mask] = value
    return out


def to_8b_image(image):
    return (255.0 * np.clip(image, 0.0, 1.0)).astype(np.uint8)


def rectangle(mask):
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]


def old_skimage(x, y, **more):
    """compare_ssim of floats before 0.20: the range of the float type, -1 to 1."""
    return structural_similarity(x, y, channel_axis=2, data_range=2.0, **more)


def chw(image):
    return torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))[None]


def splatting_ssim(x, y):
    """3D Gaussian splatting's: dense window, zeros beyond the edges."""
    line = torch.exp(-((torch.arange(11, dtype=torch.float64) - 5) ** 2) / (2 * 1.5**2))
    line /= line.sum()
    window = (line[:, None] * line)[None, None].expand(3, 1, 11, 11)
    a, b = chw(x), chw(y)

    def mean(image):
        return F.conv2d(image, window, padding=5, groups=3)

    mu_a, mu_b = mean(a), mean(b)
    var_a, var_b, cov = mean(a * a) - mu_a**2, mean(b * b) - mu_b**2, mean(a * b) - mu_a * mu_b
    top = (2 * mu_a * mu_b + 0.01**2) * (2 * cov + 0.03**2)
    return float((top / ((mu_a**2 + mu_b**2 + 0.01**2) * (var_a + var_b + 0.03**2))).mean())


def torchmetrics_map(x, y):
    _, full = structural_similarity_index_measure(chw(x), chw(y), data_range=1.0, return_full_image=True)
    return full[0].permute(1, 2, 0).numpy()


def mirrored_map(x, y):
    """scikit-image's Gaussian map of images padded beforehand, so that no edge rule of its own enters."""
    x, y = (np.pad(image, ((5, 5), (5, 5), (0, 0)), "symmetric") for image in (x, y))
    _, full = structural_similarity(
        x, y, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1.0, channel_axis=2, full=True
    )
    return full[5:-5, 5:-5]


def ihbench(pred, truth, masks, background=1.0):
    x, y = (np.rint(np.clip(unit(image), 0, 1) * 255) / 255 for image in (pred, truth))
    out = {}
    for region in ("full", "box", "body", "visible", "hidden", "never_seen"):
        mask = masks[region]
        a, b = (image if region == "full" else paint(image, mask, background) for image in (x, y))
        out[f"psnr/pooled/range1/{region}/v1"] = decibels(x[mask], y[mask])
        out[f"ssim/gauss11-1.5/range1/{region}/v1"] = mirrored_map(a, b)[mask].mean()
    return out


def neuralbody(pred, truth, masks, background=1.0):
    box = masks["box+0.05"]
    x, y = (paint(unit(image), box, background) for image in (pred, truth))
    cut = rectangle(box)
    return {
        "psnr/neuralbody-pooled/range1/box+0.05/v1": decibels(x[box], y[box]),
        "ssim/neuralbody-uniform7/range2/box+0.05/v1": old_skimage(x[cut], y[cut]),
    }


def in_8_bits_inside_the_box(pred, truth, masks, background):
    paint_of = background * 255 if pred.dtype == np.uint8 else background
    images = [paint(image, masks["box+0.3"], paint_of) for image in (pred, truth)]
    return [(image if image.dtype == np.uint8 else to_8b_image(image)) / 255.0 for image in images]


def humannerf(pred, truth, masks, background=1.0):
    x, y = in_8_bits_inside_the_box(pred, truth, masks, background)
    return {
        "psnr/humannerf-pooled/range1/full/v1": decibels(x, y),
        "ssim/humannerf-uniform7/range2/full/v1": old_skimage(x, y),
    }


def occnerf(pred, truth, masks, background=1.0):
    x, y = in_8_bits_inside_the_box(pred, truth, masks, background)
    scalar, full = old_skimage(x, y, full=True)
    out = {"psnr/occnerf-pooled/range1/full/v1": decibels(x, y), "ssim/occnerf-uniform7-map/range2/full/v1": scalar}
    for region in ("body", "visible", "box+0.3"):
        out[f"psnr/occnerf-pooled/range1/{region}/v1"] = decibels(x[masks[region]], y[masks[region]])
        out[f"ssim/occnerf-uniform7-map/range2/{region}/v1"] = full[masks[region]].mean()
    return out


def gauhuman(pred, truth, masks, background=1.0):
    x, y = np.clip(paint(unit(pred), masks["box+0.05"], background), 0, 1), np.clip(unit(truth), 0, 1)
    return {
        "psnr/gauhuman-channels/range1/full/v1": np.mean([decibels(x[..., c], y[..., c]) for c in range(3)]),
        "ssim/gauhuman-gauss11-zero/range1/full/v1": splatting_ssim(x, y),
    }


def gs_avatar_zju(pred, truth, masks, background=1.0):
    x, y = unit(pred), unit(truth)
    return {
        "psnr/3dgs-avatar-zju-pooled/range1/full/v1": decibels(x, y),
        "ssim/3dgs-avatar-zju-uniform7/range2/full/v1": old_skimage(x, y),
    }


def instantavatar(pred, truth, masks, background=1.0):
    x, y = (np.rint(np.clip(unit(image), 0, 1) * 255) / 255 for image in (pred, truth))
    full = torchmetrics_map(x, y)
    return {
        "psnr/instantavatar-pooled/range1/full/v1": decibels(x, y),
        "ssim/instantavatar-gauss11-crop5/range1/full/v1": full[5:-5, 5:-5].mean(),
        "ssim/instantavatar-gauss11/range1/full/v1": full.mean(),
    }


def gtu_mask(pred, truth, masks, background=1.0):
    mask = masks["body"]
    x, y = (unit(image) * mask[..., None] for image in (pred, truth))
    inner = mask[5:-5, 5:-5, None]
    values = torchmetrics_map(x, y)[5:-5, 5:-5]
    log_area = 10 / math.log(10) * (math.log(mask.sum() * 3) - math.log(x.size))
    return {
        "psnr/gtu-mask-pooled/range1/body/v1": decibels(x, y) + log_area,
        "ssim/gtu-mask-gauss11-crop5/range1/body/v1": (values * inner).sum() / (inner.sum() * 3),
    }


RELEASED = {
    "ihbench": ihbench,
    "neuralbody": neuralbody,
    "humannerf": humannerf,
    "occnerf": occnerf,
    "gauhuman": gauhuman,
    "3dgs-avatar-zju": gs_avatar_zju,
    "instantavatar": instantavatar,
    "gtu-mask": gtu_mask,
}


if __name__ == "__main__":
    from ihbench.metrics.oracles.cases import person_case

    case = person_case(96, 80, dtype=np.uint8)
    for name, restated in RELEASED.items():
        print(f'    "{name}": {{')
        for identity, value in restated(case.pred, case.truth, case.regions).items():
            print(f'        "{identity}": {float(value)!r},')
        print("    },")
