"""Image metrics: numbers with an identity, held to a float64 oracle. `README.md` beside this has the rules on a page.

Importing this package costs numpy only; numba is imported at the first SSIM, torch at the first LPIPS.
"""

from ihbench.metrics.aggregate import Mean, macro_mean, mean_over_frames
from ihbench.metrics.evaluate import evaluate
from ihbench.metrics.identity import Identity, Score
from ihbench.metrics.psnr import psnr
from ihbench.metrics.ssim import ssim, ssim_map

__all__ = [
    "Identity", "Mean", "Score", "evaluate", "macro_mean", "mean_over_frames", "psnr", "ssim", "ssim_map",
]  # fmt: skip
