"""Peak signal-to-noise ratio: the mean squared error is pooled over the region's pixels and channels."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench.metrics.images import Mask, bounds, checked, differing_pixels, peak_of

BAND = 2**18  # pixels worked on at a time


def psnr(
    pred: Any,  # [H, W, C] or [H, W], float in [0, 1] or uint8
    truth: Any,  # as pred
    mask: Any = None,  # [H, W] bool; None is the whole frame
    *,
    hdr: bool = False,  # take floats of any range as they are
) -> float:
    """PSNR in dB for a peak of 1 (255 for uint8): -10 log10 of the mean squared error over the mask and all channels.

    Averaging the three channels' PSNRs instead, as some released code does, is never smaller (Jensen) and is a
    different number: `mean_of_channels`. Identical images give inf, an empty mask NaN, a NaN or infinite pixel inside
    the mask NaN. Pixels outside the mask never count. Raises `ValueError` when shapes or dtypes do not match, and for
    what is no image in this sense (`images.as_image`).
    """
    pred, truth, mask = checked(pred, truth, mask, hdr=hdr)
    return SquaredError.of(pred, truth, differing_pixels(pred, truth)).pooled(mask)


def mean_of_channels(
    pred: Any,  # [H, W, C] or [H, W], float in [0, 1] or uint8
    truth: Any,  # as pred
    mask: Any = None,  # [H, W]; None is the whole frame
    *,
    hdr: bool = False,
) -> float:
    """The mean of the channels' own PSNRs, the habit of code descended from 3D Gaussian splatting.

    One channel without any error makes it inf. Otherwise as `psnr`.
    """
    pred, truth, mask = checked(pred, truth, mask, hdr=hdr)
    return SquaredError.of(pred, truth, differing_pixels(pred, truth)).mean_of_channels(mask)


@dataclass(frozen=True)
class SquaredError:
    """Squared differences of two images, shared by all regions of a frame.

    They are kept for the rectangle in which the images differ, and not divided by the peak, so that 8-bit images
    have integers there and any order of summation gives the same sum.
    """

    values: NDArray[np.float64]  # [C, h, w] inside the rectangle
    rows: slice
    columns: slice
    pixels: int  # of the frame
    peak: float

    @classmethod
    def of(
        cls,
        pred: NDArray,  # [H, W, C] or [H, W], float in [0, 1] or uint8
        truth: NDArray,  # as pred
        differs: Mask,  # [H, W] from `differing_pixels`
    ) -> SquaredError:
        """From images already checked and `differing_pixels` of them."""
        rows, columns = bounds(differs) or (slice(0, 0), slice(0, 0))
        channels = pred.shape[2] if pred.ndim == 3 else 1
        x, y = (image.reshape(*image.shape[:2], channels)[rows, columns] for image in (pred, truth))
        values = np.empty((channels, *x.shape[:2]))
        step = max(1, BAND // max(1, x.shape[1]))
        with np.errstate(invalid="ignore", over="ignore"):  # a NaN or infinite pixel becomes a NaN score, no warning
            for top in range(0, len(x), step):
                band = slice(top, top + step)
                for channel in range(channels):
                    out = values[channel, band]
                    np.subtract(x[band, :, channel], y[band, :, channel], out=out, dtype=np.float64)
                    np.multiply(out, out, out=out)
        return cls(values, rows, columns, differs.size, peak_of(pred.dtype))

    def means(
        self,
        mask: Mask | None,  # [H, W]; None is the whole frame
    ) -> list[float]:
        """The mean squared error of every channel over the mask, for a peak of 1; NaN where there is none."""
        pixels = self.pixels if mask is None else int(np.count_nonzero(mask))
        if pixels == 0:
            return [math.nan] * len(self.values)
        if mask is None:
            totals = [float(plane.sum()) for plane in self.values]
        else:
            inside = mask[self.rows, self.columns]
            weights = inside.ravel().astype(np.float64)
            # a product is much faster than a selection, but outside pixels that are not finite would spoil it
            with np.errstate(invalid="ignore"):
                totals = [float(plane.ravel() @ weights) for plane in self.values]
            totals = [
                total if math.isfinite(total) else float(np.where(inside, plane, 0).ravel() @ weights)
                for total, plane in zip(totals, self.values, strict=True)
            ]
        means = [total / pixels / self.peak**2 for total in totals]
        return [mean if math.isfinite(mean) else math.nan for mean in means]

    def pooled(
        self,
        mask: Mask | None,  # [H, W]; None is the whole frame
    ) -> float:
        """PSNR of the mean over all channels."""
        means = self.means(mask)
        return decibels(math.fsum(means) / len(means)) if means else math.nan

    def mean_of_channels(
        self,
        mask: Mask | None,  # [H, W]; None is the whole frame
    ) -> float:
        """The mean of the channels' PSNRs."""
        values = [decibels(mean) for mean in self.means(mask)]
        return sum(values) / len(values) if values else math.nan


def decibels(mse: float) -> float:
    """-10 log10 of a mean squared error for a peak of 1; inf for 0, NaN for NaN."""
    if math.isnan(mse):
        return math.nan
    return -10.0 * math.log10(mse) if mse > 0 else math.inf
