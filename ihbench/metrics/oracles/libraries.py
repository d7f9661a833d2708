"""Other people's libraries, as the check and the timing of the metrics call them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def official_flip(
    pred: NDArray,  # [H, W, 3] float in [0, 1]
    truth: NDArray,  # as pred
) -> float:
    """Mean FLIP by NVIDIA's evaluator."""
    import flip_evaluator

    reference, test = (np.ascontiguousarray(np.clip(image, 0, 1), np.float32) for image in (truth, pred))
    return float(flip_evaluator.evaluate(reference, test, "LDR", applyMagma=False)[1])


def as_torch(
    image: NDArray,  # [H, W, C]
) -> Any:
    """[1, C, H, W] tensor of the same values."""
    import torch

    return torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))[None]
