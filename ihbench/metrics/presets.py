"""The presets: our own, and each released evaluator as it computes.

Facts about the released code, to the line, stand in each preset's `source`. What they share is written once; what a
number is (8 bits or not, which pixels, which SSIM, what LPIPS was fed) stands in its identity string, which carries
the evaluator's name so that no two are ever taken for one another. The background is the protocol's: an evaluator
that was run on black gives its numbers under a protocol with a black background.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ihbench.errors import BadInput
from ihbench.metrics.eight_bit import as_float, rounded, same_type, truncated
from ihbench.metrics.evaluate import Frame, Measure, Preset, Region
from ihbench.metrics.identity import Identity, background_part
from ihbench.metrics.images import Color, Mask, bounds, differing_pixels
from ihbench.metrics.ssim import HEADLINE, Window, mean_ssim

SKIMAGE = Window(size=7, sigma=None, data_range=2.0, crop=3, sample=True)  # of float images, before version 0.20
SKIMAGE_MAP = Window(size=7, sigma=None, data_range=2.0, sample=True)  # its map, to its edges
SPLATTING = Window(border="zero")  # the lineage of 3D Gaussian splatting
TORCHMETRICS_CROP = Window(border="reflect", crop=5)  # torchmetrics up to 1.4.1
TORCHMETRICS = Window(border="reflect")  # since 1.4.2

Compute = Callable[[Frame, Mask | None], float | str]


# ----------------------------------------------------------------------------------------------------
# Ours


def _prepare_rounded(pred: NDArray, truth: NDArray, *_: object) -> tuple[NDArray, NDArray]:
    return same_type(rounded(pred), rounded(truth))


def _psnr(frame: Frame, mask: Mask | None) -> float:
    return frame.squared_error.pooled(mask)


def _ssim(frame: Frame, mask: Mask | None) -> float:
    over = partial(mean_ssim, frame.pred, frame.truth, frame.differs, background=frame.background)
    return 1 - _mean_over(frame, mask, "ssim", HEADLINE.size // 2, lambda region: 1 - over(region))


def _flip(frame: Frame, mask: Mask | None) -> float:
    from ihbench.metrics.flip import PPD, Filters, mean_flip

    over = partial(mean_flip, frame.pred, frame.truth, frame.differs, background=frame.background)
    return _mean_over(frame, mask, "flip", Filters.of(PPD).radius, over)


def _mean_over(
    frame: Frame, mask: Mask | None, name: str, radius: int, mean: Callable[[Mask | None], float]
) -> float:
    """The mean over a mask of a map that is 0 where windows agree; from the frame's where that has all of it."""
    if mask is None:
        frame.whole[name] = mean(None)
        return frame.whole[name]
    if name in frame.whole and math.isfinite(frame.whole[name]) and frame.all_within(mask, radius):
        return frame.whole[name] * mask.size / int(np.count_nonzero(mask))
    return mean(mask)


def _lpips(frame: Frame, mask: Mask | None) -> float | str:
    """Painted and cropped to the body's box, so that the same crop serves every region of a frame."""
    if mask is None:
        return _network("vgg", "[-1,1]", frame.pred, frame.truth)
    box = frame.regions.get("box", "region 'box', to which LPIPS crops, was not given")
    if isinstance(box, str):
        return box
    return _network("vgg", "[-1,1]", frame.pred, frame.truth, mask, frame.background, box)


def _named(metric: str, variant: str, value_range: str, painted: bool = False) -> Callable[[str, Color], Identity]:
    """The identity of a metric; `painted` where it paints what lies outside a region."""
    return partial(_identity, metric, variant, value_range, painted)


def _identity(metric: str, variant: str, value_range: str, painted: bool, region: str, background: Color) -> Identity:
    paint = background_part(background) if painted and region != "full" else ""
    return Identity(metric, variant, value_range, region, version=1, background=paint)


def _lacking(net: str) -> str:
    """What is lacking for LPIPS with this trunk."""
    from ihbench.metrics import lpips

    return lpips.lacking(net)


IHBENCH = Preset(
    name="ihbench",
    about="8-bit images; pooled PSNR, Gaussian SSIM, LPIPS (VGG) and FLIP; regions painted first, nothing leaks in",
    source="this bench",
    prepare=_prepare_rounded,
    measures=(
        Measure(_named("psnr", "pooled", "range1"), _psnr,
                "-10 log10 of the mean squared error over the region's pixels and channels"),
        Measure(_named("ssim", "gauss11-1.5", "range1", painted=True), _ssim,
                "mean over the region of the SSIM map: Gaussian 11×11, sigma 1.5, population moments, mirrored "
                "edges"),
        Measure(_named("lpips", "vgg-0.1", "[-1,1]", painted=True), _lpips,
                "LPIPS v0.1, VGG, fed [-1,1]; regions cropped to the body's box", slow=True,
                lacking=partial(_lacking, "vgg")),
        Measure(_named("flip", "ldr-67ppd", "srgb", painted=True), _flip,
                "mean over the region of the LDR-FLIP map at 67 pixels per degree; needs no weights"),
    ),
    needs=("box",),
)  # fmt: skip


# ----------------------------------------------------------------------------------------------------
# Released evaluators


def _floats(pred: NDArray, truth: NDArray, *_: object) -> tuple[NDArray, NDArray]:
    return as_float(pred), as_float(truth)


def _clamped(image: NDArray) -> NDArray:
    return np.clip(as_float(image), 0, 1)


def _outside(image: NDArray, region: Region, background: Color) -> NDArray:
    """The image painted outside a region, in its own type."""
    if region is None:
        return image
    paint = np.asarray(background) * (255 if image.dtype == np.uint8 else 1)
    return np.where(np.asarray(region)[..., None], image, paint.astype(image.dtype))


def _boxed(
    box: str, to: Callable[[NDArray], NDArray], both: bool,
    pred: NDArray, truth: NDArray, regions: Mapping[str, Region], background: Color,
) -> tuple[NDArray, NDArray] | str:  # fmt: skip
    """Paint the prediction, or both images, outside the projected box, then convert both."""
    region = regions.get(box, f"region {box!r}, outside of which this evaluator paints, was not given")
    if isinstance(region, str):
        return region
    truth = _outside(truth, region, background) if both else truth
    return same_type(to(_outside(pred, region, background)), to(truth))


def _network(
    net: str,
    feed: str,
    pred: NDArray,
    truth: NDArray,
    mask: Mask | None = None,
    background: Color = (1.0, 1.0, 1.0),
    crop: Mask | None = None,
) -> float | str:
    """LPIPS, or why there is none."""
    from ihbench.metrics.lpips import lpips

    try:
        return lpips(pred, truth, mask, net=net, feed=feed, background=background, crop=crop, hdr=True)  # checked
    except BadInput as error:
        return str(error)


def _occnerf_ssim(frame: Frame, mask: Mask | None) -> float:
    """Mean over the mask of the unpainted map; the whole frame's scalar leaves out the library's border."""
    window = SKIMAGE if mask is None else SKIMAGE_MAP
    return mean_ssim(frame.pred, frame.truth, frame.differs, mask, window, background=None)


def _whole_ssim(window: Window) -> Compute:
    return lambda frame, mask: mean_ssim(frame.pred, frame.truth, frame.differs, None, window)


def _box_ssim(frame: Frame, mask: Mask | None) -> float:
    """SSIM of both images painted outside the box and cut to its bounding rectangle."""
    if mask is None:
        return mean_ssim(frame.pred, frame.truth, frame.differs, None, SKIMAGE)
    rectangle = bounds(mask)
    assert rectangle is not None  # evaluate() hands over masks with pixels only
    pred, truth = (_outside(image, mask, frame.background)[rectangle] for image in (frame.pred, frame.truth))
    return mean_ssim(pred, truth, differing_pixels(pred, truth), None, SKIMAGE)


def _gtu_ssim(frame: Frame, mask: Mask | None) -> float:
    """Both images black outside the mask, 5 px of the map cut off, the mean over what is left of the mask."""
    return mean_ssim(frame.pred, frame.truth, frame.differs, mask, TORCHMETRICS_CROP, background=0.0)


def _gtu_lpips(frame: Frame, mask: Mask | None) -> float | str:
    """Mid-grey, 0 after the mapping to [-1,1], outside the mask; the whole frame."""
    whole = np.ones(frame.pred.shape[:2], np.bool_)
    return _network("alex", "[-1,1]", frame.pred, frame.truth, mask, (0.5, 0.5, 0.5), whole)


PSNR_FORMS: dict[str, tuple[Compute, str]] = {
    "pooled": (_psnr, "mean squared error pooled over pixels and channels"),
    "channels": (lambda frame, mask: frame.squared_error.mean_of_channels(mask), "mean of channel PSNRs"),
}
SSIM_FORMS = {  # name -> value range, definition
    "uniform7": ("range2", "scikit-image's uniform 7×7, sample moments, 3 px of the edges cut off, data range 2"),
    "uniform7-map": (
        "range2", "region mean of scikit-image's uniform 7×7 map, sample moments, data range 2, nothing painted"
    ),
    "gauss11-zero": ("range1", "Gaussian 11×11, sigma 1.5, zeros beyond the edges"),
    "gauss11-crop5": ("range1", "Gaussian 11×11, sigma 1.5, 5 px of the edges cut off"),
    "gauss11": ("range1", "Gaussian 11×11, sigma 1.5, edges reflected, none cut off"),
}  # fmt: skip


def _measures(
    evaluator: str,
    psnr_form: str,
    ssim: dict[str, Compute],  # by form
    lpips: tuple[str, str] | None = None,  # net, feed
    regions: tuple[str, ...] = ("full",),
    lpips_of: Compute | None = None,  # None: over the whole frame
) -> tuple[Measure, ...]:
    """PSNR, SSIM and LPIPS of a released evaluator under its own name."""
    measures = [Measure(_named("psnr", f"{evaluator}-{psnr_form}", "range1"), *PSNR_FORMS[psnr_form], regions)]
    if lpips is not None:
        net, feed = lpips
        compute = lpips_of or (lambda frame, mask: _network(net, feed, frame.pred, frame.truth))
        identity, about = _named("lpips", f"{evaluator}-{net}", feed), f"LPIPS v0.1, {net}, fed {feed}"
        measures.append(Measure(identity, compute, about, regions, slow=True, lacking=partial(_lacking, net)))
    for k, (form, compute) in enumerate(ssim.items()):
        value_range, about = SSIM_FORMS[form]
        measure = Measure(_named("ssim", f"{evaluator}-{form}", value_range), compute, about, regions)
        measures.insert(2 * k + 1, measure)  # PSNR, SSIM, LPIPS; a second SSIM comes last
    return tuple(measures)


NEURALBODY = Preset(
    name="neuralbody",
    about="the projected 3-D box: PSNR over its pixels, SSIM on its bounding rectangle",
    source="zju3dv/neuralbody 3c516b9 lib/evaluators/if_nerf.py:15-68; scikit-image 0.14 compare_ssim",
    prepare=_floats,
    measures=_measures("neuralbody", "pooled", {"uniform7": _box_ssim}, regions=("box+0.05",)),
    needs=("box+0.05",),
)

HUMANNERF = Preset(
    name="humannerf",
    about="the whole frame in 8 bits, both images painted outside the projected box",
    source="chungyiweng/humannerf c753322 run.py:36-49, core/utils/image_util.py:18; metrics as told in its issue 8",
    prepare=partial(_boxed, "box+0.3", truncated, True),
    measures=_measures("humannerf", "pooled", {"uniform7": _whole_ssim(SKIMAGE)}, ("vgg", "[-1,1]")),
    needs=("box+0.3",),
)

OCCNERF = Preset(
    name="occnerf",
    about="8 bits; its vis is our body (on OcMotion our visible), its body our box; region means of one SSIM map",
    source="tiangexiang/OccNeRF 1cb1ef3 eval.py (unpack_to_image to psnr_metric, eval_model)",
    prepare=partial(_boxed, "box+0.3", truncated, True),
    measures=_measures(
        "occnerf", "pooled", {"uniform7-map": _occnerf_ssim}, regions=("body", "visible", "box+0.3", "full")
    ),
    needs=("box+0.3", "body", "visible"),
)

GAUHUMAN = Preset(
    name="gauhuman",
    about="the whole frame, clamped; the prediction alone painted outside the box; also OccFusion's definition",
    source="skhu101/GauHuman 732ec0d render.py:61-91, utils/image_utils.py:17-19, utils/loss_utils.py; "
    "tiangexiang/OccFusion f41e091 stage1.py:302-351",
    prepare=partial(_boxed, "box+0.05", _clamped, False),
    measures=_measures("gauhuman", "channels", {"gauss11-zero": _whole_ssim(SPLATTING)}, ("vgg", "[0,1]")),
    needs=("box+0.05",),
)

GS_AVATAR_ZJU = Preset(
    name="3dgs-avatar-zju",
    about="the whole frame as rendered, not clamped",
    source="mikeqzy/3dgs-avatar-release fc39bc5 utils/general_utils.py:221-291",
    prepare=_floats,
    measures=_measures("3dgs-avatar-zju", "pooled", {"uniform7": _whole_ssim(SKIMAGE)}, ("vgg", "[-1,1]")),
)

INSTANTAVATAR = Preset(
    name="instantavatar",
    about="the whole frame read back from 8-bit PNG; torchmetrics as of its time, and the SSIM of later releases",
    source="tijiang13/InstantAvatar 3cdfd49 eval.py:14-33,94-105; also aipixel/GaussianAvatar d981c62 eval.py:16-35",
    prepare=_prepare_rounded,
    measures=_measures(
        "instantavatar",
        "pooled",
        {"gauss11-crop5": _whole_ssim(TORCHMETRICS_CROP), "gauss11": _whole_ssim(TORCHMETRICS)},
        ("alex", "[0,1]"),
    ),
)

GTU_MASK = Preset(
    name="gtu-mask",
    about="the true silhouette: PSNR over its pixels; SSIM with black, LPIPS with mid-grey outside it",
    source="snuvclab/gtu 6b3026c utils/metric_utils.py:44-160",
    prepare=_floats,
    # its PSNR of masked images, corrected by the log of the mask's area, is the PSNR over the mask's pixels
    measures=_measures(
        "gtu-mask", "pooled", {"gauss11-crop5": _gtu_ssim}, ("alex", "[-1,1]"), ("body",), lpips_of=_gtu_lpips
    ),
    needs=("body",),
)
