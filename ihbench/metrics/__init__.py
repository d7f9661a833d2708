"""Image metrics: numbers with an identity, held to a float64 oracle.

Importing this package costs numpy only; cv2 is imported at the first SSIM, torch never.
"""

from ihbench.metrics.aggregate import Mean, macro_mean, mean_over_frames
from ihbench.metrics.evaluate import evaluate
from ihbench.metrics.identity import Identity, Score
from ihbench.metrics.psnr import psnr
from ihbench.metrics.ssim import ssim, ssim_map

__all__ = [
    "Identity", "Mean", "Score", "evaluate", "macro_mean", "mean_over_frames", "psnr", "ssim", "ssim_map",
]  # fmt: skip
