"""What a number is: its identity string travels with it, and numbers of different identity are never mixed.

    ssim/gauss11-1.5/range1/visible/v1
    metric / variant / value range / region / [painted background /] version

The background is named only when it is not white and entered the number: a region painted before windows ran over it.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated

from ihbench.config_fields import Within


@dataclass(frozen=True)
class Metric:
    """How a metric is shown; what is stored is never scaled."""

    title: str
    higher_is_better: bool
    decimals: int
    scale: float = 1.0  # a table shows the value times this
    unit: str = ""

    @property
    def arrow(self) -> str:
        return "↑" if self.higher_is_better else "↓"

    def head(self, where: str = "") -> str:
        """The head of a column: "PSNR hidden ↑"."""
        return " ".join(filter(None, (self.title, where, self.arrow)))

    def text(self, value: float) -> str:
        """A value as a table shows it: "—" when absent, "∞" without any error."""
        if math.isnan(value):
            return "—"
        if math.isinf(value):
            return "∞" if value > 0 else "−∞"
        return f"{value * self.scale:.{self.decimals}f}"


METRICS = {
    "psnr": Metric("PSNR", True, 2, unit="dB"),
    "ssim": Metric("SSIM", True, 4),
    "lpips": Metric("LPIPS*", False, 1, 1000.0, "× 1000"),
    "flip": Metric("FLIP", False, 4),
}

PART = re.compile(r"[A-Za-z0-9_.,+\[\]-]+")


@dataclass(frozen=True)
class Identity:
    """The parts of an identity string; `str` joins them, `parse` splits them."""

    metric: str  # "psnr"
    variant: str  # "pooled", "gauss11-1.5"
    value_range: str  # "range1": the data range, or what a network was fed
    region: str  # "full", "box", "body", "visible", "hidden", "never_seen"
    version: int  # counted up when the definition changes
    background: str = ""  # "" for white or not painted, else "bg0,0,0"

    def __post_init__(self) -> None:
        for part in (self.metric, self.variant, self.value_range, self.region, self.background or "-"):
            if not PART.fullmatch(part):
                raise ValueError(f"metric identity: expected letters, digits and _.,+[]- in every part, got {part!r}")

    def __str__(self) -> str:
        parts = [self.metric, self.variant, self.value_range, self.region, self.background, f"v{self.version}"]
        return "/".join(part for part in parts if part)

    @property
    def display(self) -> Metric:
        """How its metric is shown."""
        return metric_of(self.metric)

    @classmethod
    @lru_cache(10_000)
    def parse(cls, text: str) -> Identity:
        """The parts of an identity string. Raises `ValueError` when it is none."""
        *parts, version = text.split("/")
        if len(parts) not in (4, 5) or not re.fullmatch(r"v[0-9]+", version) or "" in parts:
            raise ValueError(f"metric identity: expected metric/variant/range/region/v1, got {text!r}")
        metric, variant, value_range, region, *background = parts
        return cls(metric, variant, value_range, region, int(version[1:]), *background)


@dataclass(frozen=True)
class Score:
    """One number, what it is, and, when it is absent (NaN), why."""

    value: Annotated[float, Within(nan=True, infinite=True)]
    identity: str
    reason: str = ""

    def __post_init__(self) -> None:
        if math.isnan(self.value) and not self.reason:
            raise ValueError(f"score {self.identity}: an absent number (NaN) needs a reason")

    @property
    def absent(self) -> bool:
        return math.isnan(self.value)

    @classmethod
    def missing(cls, identity: str, reason: str) -> Score:
        return cls(math.nan, identity, reason)


def metric_of(name: str) -> Metric:
    """How a metric is shown; one that a third party added has its own name and 4 decimals."""
    return METRICS.get(name, Metric(name, True, 4))


def background_part(background: tuple[float, float, float]) -> str:
    """How a painted background appears in an identity: nothing for white."""
    return "" if tuple(background) == (1, 1, 1) else "bg" + ",".join(f"{value:g}" for value in background)
