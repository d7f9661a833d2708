"""Occlusion rules: which pixels of the original training images an occluder hides.

A rule is a pure function of an `OcclusionRequest`. It hides whole pixels of the original, distorted image, before
undistortion, as the released readers do.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ihbench.errors import BadInput
from ihbench.occlusion import Occlusion, OcclusionRequest


def none(request: OcclusionRequest) -> Occlusion:
    """Hides nothing."""
    return Occlusion("none", np.zeros(request.width, bool), {})


def fixed_strip(request: OcclusionRequest) -> Occlusion:
    """All rows of columns [mid - width//2, mid + width//2), the same in every covered frame.

    The columns are published per subject for 1024-px images (tiangexiang/OccFusion scene/dataset_readers.py:562-569,
    tiangexiang/OccNeRF configs) and scale with the image width. Raises `BadInput` for a subject without a strip.
    """
    rule = request.rule
    if request.subject not in rule.strips:
        raise BadInput(f"occlusion 'fixed-strip': no strip is published for subject {request.subject!r}")
    mid, width = rule.strips[request.subject]
    scale = request.width / rule.reference_width
    return _strip("fixed-strip", round(mid * scale), round(width * scale), request.width)


def strip_generic(request: OcclusionRequest) -> Occlusion:
    """The same kind of strip for any data: centred on the mean person column over the covered frames, as wide as it
    must be (smallest even width) to hide at least `fraction` of the pooled person pixels.

    Reproduces what the comments in OccNeRF's subject files say their strips were tuned for. Raises `BadInput` when no
    covered frame shows anybody.
    """
    columns = np.zeros(request.width, np.int64)
    for frame, covered in zip(request.frames, request.covered, strict=True):
        if covered:
            columns += request.silhouette(frame).sum(0)
    total = int(columns.sum())
    if total == 0:
        raise BadInput(f"occlusion 'strip-generic': no person pixel in any covered frame of {request.subject!r}")
    mid = round(float((np.arange(request.width) * columns).sum() / total))
    for width in range(0, 2 * request.width + 2, 2):
        strip = _strip("strip-generic", mid, width, request.width)
        if columns[strip.columns].sum() >= request.rule.fraction * total:
            return strip
    raise AssertionError("a strip twice as wide as the image hides every pixel")


def _strip(rule: str, mid: int, width: int, image_width: int) -> Occlusion:
    columns: NDArray[np.bool_] = np.zeros(image_width, bool)
    columns[max(0, mid - width // 2) : max(0, mid + width // 2)] = True
    return Occlusion(rule, columns, {"mid": mid, "width": width})
