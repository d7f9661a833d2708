"""Metrics by the names that papers head columns with: which way is better, and in what unit."""

from __future__ import annotations

import re
from dataclasses import dataclass

UP, DOWN = "↑", "↓"
# name -> is higher better. Names of one metric share a key.
QUALITY = {
    "psnr": True, "ms-ssim": True, "ssim": True, "iou": True, "miou": True, "fsim": True, "vif": True,
    "accuracy": True, "f-score": True, "f1": True, "precision": True, "recall": True, "map": True,
    "lpips": False, "dssim": False, "dists": False, "flip": False, "fid": False, "kid": False, "fvd": False,
    "niqe": False, "mse": False, "rmse": False, "mae": False, "mpjpe": False, "pa-mpjpe": False, "pve": False,
    "chamfer": False, "p2s": False,
}  # fmt: skip
COST = {
    "fps": True, "time": False, "latency": False, "runtime": False, "seconds": False, "memory": False,
    "params": False, "parameters": False, "flops": False, "gflops": False, "storage": False,
}  # fmt: skip
BOUNDED = {  # by 1
    "ssim", "ms-ssim", "lpips", "dssim", "dists", "flip", "iou", "miou", "accuracy", "precision", "recall",
}  # fmt: skip
NAMES = sorted((*QUALITY, *COST), key=len, reverse=True)
NAME = re.compile(rf"(?<![A-Za-z-])({'|'.join(map(re.escape, NAMES))})(?![A-Za-z])", re.IGNORECASE)
ARROW = re.compile("[↑↓⬆⬇⇑⇓]")
UPWARD = "↑⬆⇑"
SCALE = re.compile(r"[×x*·]?\s*\b(1000|1e3|1e-3|10\s*-?3|100)\b|%", re.IGNORECASE)
UNIT = re.compile(r"[(\[]\s*(dB|%|s|sec|ms|min|h|hours?|GB|GiB|MB|MiB|M|K|mm|cm|m)\s*[)\]]", re.IGNORECASE)
THRESHOLD = re.compile(r"[≥≤<>]\s*=?\s*[\d.]")
STAR = re.compile(r"\s*[*∗⋆]")


@dataclass(frozen=True)
class HeadMetric:
    """What the head of a column says of its metric."""

    name: str = ""  # "lpips"; as written where nobody knows it
    arrow: str = ""  # "↑", "↓" or ""
    scaled: bool = False  # a star, × 1000 or % stands beside the name
    unit: str = ""  # "db"

    @property
    def cost(self) -> bool:
        """Seconds, bytes and their like, whose arrows nobody misses."""
        return self.name in COST

    @property
    def usual(self) -> bool | None:
        """Whether higher is better for a metric of this name; None where nobody knows."""
        return QUALITY.get(self.name, COST.get(self.name))

    @property
    def higher_is_better(self) -> bool:
        return self.arrow == UP if self.usual is None else self.usual


NO_METRIC = HeadMetric()


def head_metric(text: str) -> HeadMetric | None:
    """The metric that a head names; None for a head with neither a known name nor an arrow, and for a threshold:
    below "PSNR ≥ 25 dB" stand times, or whatever it took."""
    name, arrow = NAME.search(text), ARROW.search(text)
    after = text[name.end() :] if name else ""
    if arrow is None and (name is None or THRESHOLD.search(after)):
        return None
    unit = UNIT.search(text)
    return HeadMetric(
        name=name[1].lower() if name else ARROW.sub("", text).strip().lower(),
        arrow="" if arrow is None else UP if arrow[0] in UPWARD else DOWN,
        scaled=bool(STAR.match(after) or SCALE.search(after)),
        unit=unit[1].lower() if unit else "",
    )
