"""What counts as an image here, and the checks every metric begins with.

An image is [H, W], [H, W, 1] or [H, W, 3], uint8 with peak 255 or floating point with peak 1, numpy or torch,
contiguous or not. Another layout or range would give a number that looks right, so it is refused with the word that
mends it. A network's output may overshoot [0, 1] by `OVERSHOOT` and is taken as it is (8-bit presets clip);
`hdr=True` takes floats of any range as they are.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Color = tuple[float, float, float]
Mask = NDArray[np.bool_]  # [H, W]

OVERSHOOT = 0.25  # of the range: what an image without a last clamp may leave it by, at either end


def as_image(
    image: Any,  # [H, W] or [H, W, C], float in [0, 1] or uint8
    name: str = "image",
    *,
    hdr: bool = False,
    data_range: float = 1.0,
) -> NDArray:
    """The image as a numpy array [H, W] or [H, W, C]: uint8, float16, float32 or float64, C 1 or 3.

    Tensors of any device are copied to the CPU without their gradient. bfloat16, which numpy lacks, becomes float32
    without loss. `data_range` is the peak of floats; `hdr=True` leaves their range alone. Pixels that are not finite
    are no fault here. Raises `ValueError`, naming what was given, for anything else.
    """
    array = _as_numeric(image, name)
    if array.dtype != np.uint8 and array.dtype.name not in ("float16", "float32", "float64"):
        raise ValueError(f"{name}: expected uint8, or floats with peak 1, got {array.dtype}{_of_type(array)}")
    fault = _layout_fault(array.shape)
    if fault is not None:
        raise ValueError(f"{name}: expected [H, W] or [H, W, 3], got {array.shape}{fault}")
    if not hdr:
        check_range(array, name, data_range=data_range)
    return array


def check_range(
    image: NDArray,  # [H, W, C] or [H, W], float in [0, 1] or uint8
    name: str,
    mask: Mask | None = None,  # [H, W] the pixels that count; None is all
    *,
    data_range: float = 1.0,
    below: float = OVERSHOOT,
    above: float = OVERSHOOT,
    otherwise: str = "; hdr=True takes any range as it is",
) -> None:
    """Raise `ValueError`, with the word that mends it, where floats leave [0, data_range] by more than a share of it.

    Pixels that are not finite are left to the metrics.
    """
    if image.dtype == np.uint8:
        return
    fault = range_fault(*extent(image), data_range, below, above)
    if fault and mask is not None:  # only then, since selecting takes longer than looking at all
        fault = range_fault(*extent(image[mask]), data_range, below, above)
    if fault:
        raise ValueError(f"{name}: {fault}{otherwise}")


def range_fault(
    low: float, high: float, data_range: float = 1.0, below: float = OVERSHOOT, above: float = OVERSHOOT
) -> str:
    """What is wrong with floats from `low` to `high` as an image, and the word that mends it; "" for nothing."""
    if low >= -below * data_range and high <= (1 + above) * data_range:
        return ""
    if low >= -below and 2 < high <= 255.5:
        word = "8-bit values are divided by 255"
    elif low >= -below and 255.5 < high <= 65535.5:
        word = "16-bit values are divided by 65535"
    elif low >= -1 - OVERSHOOT and high <= 1 + OVERSHOOT:
        word = "values from -1 to 1 are made right by (image + 1) / 2"
    elif -4 < low < 0 and high < 4:
        word = "undo a normalisation by mean and deviation"
    else:
        word = "clip it"
    return f"expected floats from 0 to {data_range:g}, got {low:.4g} to {high:.4g}; {word}"


def extent(
    image: NDArray,  # [H, W, C] or [H, W], float in [0, 1] or uint8
) -> tuple[float, float]:
    """The smallest and the largest finite value; (0, 0) where there is none."""
    if image.size == 0:
        return 0.0, 0.0
    low, high = float(image.min()), float(image.max())
    if not (math.isfinite(low) and math.isfinite(high)):
        values = image[np.isfinite(image)]
        return (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)
    return low, high


def as_mask(
    mask: Any,  # [H, W] bool
    shape: tuple[int, ...],
    name: str = "mask",
) -> Mask:
    """A mask of images [H, W, …] as a bool array [H, W]; tensors are copied to the CPU. Raises `ValueError`."""
    array = _as_numeric(mask, name)
    if array.shape == shape[:2] and array.dtype == np.bool_:
        return array
    word = ""
    if array.ndim == 3 and 1 in (array.shape[0], array.shape[2]) and array.size == math.prod(shape[:2]):
        word = "; give its one channel, [H, W]"
    elif array.ndim == 3:
        word = "; one channel of it, or any(-1), makes a mask"
    elif array.shape == shape[1::-1]:
        word = "; rows and columns are exchanged: transpose it"
    elif array.shape != shape[:2]:
        word = "; give the mask of these images, of their size"
    elif array.dtype.kind == "f":
        word = "; a soft mask needs a threshold: mask > 0.5"
    elif array.dtype.kind in "iu":
        word = "; say what counts: mask != 0 (mask > 127 for an anti-aliased one)"
    raise ValueError(
        f"{name}: expected bool {tuple(shape[:2])} like the images, got {array.dtype} {array.shape}{word}"
    )


def as_background(background: Any, channels: int, data_range: float = 1.0) -> NDArray[np.float64]:
    """[1] or [channels] what is painted outside a mask, in units of floats. Raises `ValueError`."""
    try:
        values = np.asarray(_as_numeric(np.asarray(background), "background"), np.float64).reshape(-1)
    except (TypeError, ValueError):
        values = np.zeros(0)
    if values.size not in (1, channels) or not ((values >= 0) & (values <= data_range)).all():
        word = "; 8-bit values are divided by 255" if values.size in (1, channels) and values.max() > 1 else ""
        raise ValueError(
            f"background: expected 1 or {channels} numbers from 0 to {data_range:g}, got {background!r}{word}"
        )
    return values


def check_images(
    pred: NDArray,  # [H, W, C] or [H, W], float in [0, 1] or uint8
    truth: NDArray,  # as pred
    *,
    mixed: bool = False,
) -> None:
    """Raise `ValueError`, naming both sides, unless two images can be compared; `mixed`: one may be uint8."""
    if pred.shape != truth.shape:
        word = ""
        if pred.shape[:2] == truth.shape[:2]:
            word = "; repeat the grey one's channel, or drop it from both"
        elif pred.shape[:2] == truth.shape[1::-1]:
            word = "; rows and columns of one are exchanged: transpose it"
        raise ValueError(
            f"images: expected two of the same shape [H, W] or [H, W, C], got pred {pred.shape}, "
            f"truth {truth.shape}{word}"
        )
    if not mixed and (pred.dtype == np.uint8) != (truth.dtype == np.uint8):
        raise ValueError(
            f"images: expected both uint8 or both float, got pred {pred.dtype}, truth {truth.dtype}; "
            f"divide the uint8 one by 255"
        )


def check_brightness(
    pred: NDArray,  # [H, W, C] or [H, W], float in [0, 1] or uint8
    truth: NDArray,  # as pred
    data_range: float = 1.0,
) -> None:
    """Raise `ValueError` for two images of which no pixel is brighter than one 8-bit level, and neither is black.

    Such are divided by 255 twice, cast to uint8 before they were multiplied, or measured with another data range;
    their errors would all be 48 dB too small.
    """
    images = {"pred": pred, "truth": truth}
    level = 1 if pred.dtype == np.uint8 else 1.001 * data_range / 255
    extents = [extent(image) for image in images.values()]
    if pred.size == 0 or any(high > level for _, high in extents) or any(low == high == 0 for low, high in extents):
        return
    brightest = max(high for _, high in extents)
    word = "multiply by 255 before the cast to uint8" if pred.dtype == np.uint8 else "divided by 255 twice?"
    if data_range > 2:
        word = f"of images in 0..1 the data range is 1, not {data_range:g}"
    raise ValueError(
        f"images: no pixel of either is brighter than {brightest:.4g}, one level of 255; {word} "
        f"(hdr=True takes them as they are)"
    )


def checked(
    pred: Any,  # [H, W, C] or [H, W], float in [0, 1] or uint8
    truth: Any,  # as pred
    mask: Any = None,  # [H, W] bool; None is the whole frame
    *,
    hdr: bool = False,
    data_range: float = 1.0,
) -> tuple[NDArray, NDArray, Mask | None]:
    """Two images and a mask as numpy arrays that can be compared. Raises `ValueError` otherwise."""
    pred, truth = as_image(pred, "pred", hdr=True), as_image(truth, "truth", hdr=True)
    check_images(pred, truth)
    mask = None if mask is None else as_mask(mask, pred.shape)
    if not hdr:
        for image, name in ((pred, "pred"), (truth, "truth")):
            check_range(image, name, mask, data_range=data_range)
    if pred.dtype == np.uint8 and data_range > 2:  # 2 is what old scikit-image assumed of any float image
        raise ValueError(f"data_range {data_range:g}: uint8 images have peak 255 by themselves; leave it at 1")
    if not hdr:
        check_brightness(pred, truth, data_range)
    return pred, truth, mask


def _as_numeric(value: Any, name: str) -> NDArray:
    """An array or a tensor as a plain numpy array of numbers in the machine's byte order. Raises `ValueError`."""
    if hasattr(value, "detach"):  # a torch tensor; torch itself is not imported for this
        value = value.detach().cpu().to_dense()
        value = (value.float() if "bfloat16" in str(value.dtype) else value).numpy()
    if isinstance(value, np.ma.MaskedArray):
        raise ValueError(f"{name}: expected a plain array, got a masked one; fill it, and give its mask as `mask`")
    if not isinstance(value, np.ndarray):
        kind = type(value).__name__
        word = "np.asarray(image.convert('RGB'))" if type(value).__module__.startswith("PIL.") else "np.asarray"
        raise ValueError(f"{name}: expected a numpy array or a torch tensor, got {kind}; convert it with {word}")
    value = np.asarray(value)  # without a subclass's own ideas of an index
    return value if value.dtype.isnative else value.astype(value.dtype.newbyteorder("="))


def _of_type(array: NDArray) -> str:
    """The word for an image of another type."""
    if array.dtype == np.bool_:
        return "; multiply by 255 as uint8, or give it as a mask"
    if array.dtype.kind in "iu" and array.size and array.min() >= 0 and array.max() <= 255:
        return "; its values fit uint8: astype(np.uint8)"
    if array.dtype.kind in "iu":
        return "; divide by its largest possible value (65535 for 16 bits)"
    return "; astype(np.float64)" if array.dtype.kind == "f" else ""


def _layout_fault(shape: tuple[int, ...]) -> str | None:
    """What mends the shape of an image, as the end of a sentence; None where nothing is wrong with it."""
    if len(shape) == 2 or (len(shape) == 3 and shape[2] in (1, 3)):
        return None
    if len(shape) == 4:
        return "; give one image of the batch a call" + ("" if shape[3] in (1, 3) else ", channels last")
    if len(shape) != 3:
        return ""
    if shape[0] in (1, 3, 4):
        return "; channels come last: move axis 0 to the end"
    if shape[2] in (2, 4):
        return "; composite RGBA on the background first: alpha is no colour"
    return "; channels come last, 1 or 3 of them"


def peak_of(dtype: np.dtype) -> float:
    """The largest value of an image of this dtype: 255 for uint8, 1 for floats."""
    return 255.0 if dtype == np.uint8 else 1.0


def in_colour(
    image: NDArray,  # [H, W, C] or [H, W], C 1 or 3
) -> NDArray:
    """[H, W, 3], not to be written to; grey images get three equal channels."""
    return np.broadcast_to(image if image.ndim == 3 else image[..., None], (*image.shape[:2], 3))


def differing_pixels(
    pred: NDArray,  # [H, W, C] or [H, W], float in [0, 1] or uint8
    truth: NDArray,  # as pred
) -> Mask:
    """[H, W] True where the images differ in any channel, or hold something that is not finite."""
    values = pred != truth
    if pred.dtype != np.uint8:
        values |= ~np.isfinite(pred)
    if values.ndim == 2:
        return values
    out = np.zeros(values.shape[:2], np.bool_)
    for channel in range(values.shape[2]):  # ten times faster than any(axis=-1) over an axis of three
        out |= values[..., channel]
    return out


def bounds(
    mask: Mask,  # [H, W]
) -> tuple[slice, slice] | None:
    """Rows and columns of the smallest rectangle that holds every True pixel; None without any."""
    rows = np.flatnonzero(mask.any(1))
    if len(rows) == 0:
        return None
    columns = np.flatnonzero(mask[rows[0] : rows[-1] + 1].any(0))
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def grown(area: tuple[slice, slice], radius: int, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """The rectangle grown by `radius` on every side, as far as an image of this shape goes."""
    rows, columns = area
    return (
        slice(max(rows.start - radius, 0), min(rows.stop + radius, shape[0])),
        slice(max(columns.start - radius, 0), min(columns.stop + radius, shape[1])),
    )
