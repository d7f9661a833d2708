"""Whether systems measured here stand in the order in which a paper prints them.

Spearman's rho and Kendall's tau-b over systems, of their means over people, with bootstrap intervals over people.
Only the order is compared: the paper's people, images and definitions are others than the bench's.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench.metrics.statistics import BOOTSTRAP_FROM, cluster_bootstrap

LEAST_SYSTEMS = 3  # two can only agree or not
LEVEL = 0.95


@dataclass(frozen=True)
class Coefficient:
    """A rank correlation; the ends of its interval are NaN for a single person."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        ends = f" [{self.low:+.2f}, {self.high:+.2f}]" if math.isfinite(self.low) else ""
        return f"{self.value:+.2f}{ends}"


@dataclass(frozen=True)
class RankAgreement:
    systems: tuple[str, ...]
    people: tuple[str, ...]  # that all systems were measured on
    spearman: Coefficient
    kendall: Coefficient

    def __str__(self) -> str:
        n = len(self.people)
        interval = f"; {LEVEL:.0%} bootstrap intervals over people" if n > 1 else "; one person gives no interval"
        interval += f", too narrow with fewer than {BOOTSTRAP_FROM}" if 1 < n < BOOTSTRAP_FROM else ""
        return (
            f"Spearman's rho {self.spearman}, Kendall's tau {self.kendall} over {len(self.systems)} systems "
            f"({', '.join(self.systems)}) and {n} {'people' if n > 1 else 'person'} ({', '.join(self.people)})"
            f"{interval}"
        )


def rank_agreement(
    printed: Mapping[str, float],  # system -> its number in the paper
    measured: Mapping[str, Mapping[str, float]],  # system -> person -> score, of the same metric
    level: float = LEVEL,
) -> RankAgreement | str:
    """Agreement of the two orders over systems that both have, on people that all of these were measured on; in words
    why there is none. A metric of which less is better needs no turning: both orders turn."""
    systems = tuple(s for s, value in printed.items() if math.isfinite(value) and measured.get(s))
    if len(systems) < LEAST_SYSTEMS:
        return f"{len(systems)} systems are both printed and measured, at least {LEAST_SYSTEMS} have an order"
    people = sorted(set.intersection(*(set(measured[system]) for system in systems)))
    if not people:
        return f"{', '.join(systems)} were not measured on a common person"
    scores = np.array([[measured[system][person] for person in people] for system in systems])  # [K, n]
    order = np.array([printed[system] for system in systems])
    return RankAgreement(
        systems, tuple(people), *(_coefficient(which, order, scores, level) for which in (spearman, kendall))
    )


def spearman(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:  # [K] each
    """Spearman's rho; 0 where all of one are equal, which has no order to agree with."""
    from scipy import stats

    return _defined(stats.spearmanr, a, b)


def kendall(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:  # [K] each
    """Kendall's tau-b, which accounts for ties; 0 as for `spearman`."""
    from scipy import stats

    return _defined(stats.kendalltau, a, b)


def _defined(function: Callable[..., Any], a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of constant input
        value = float(function(a, b)[0])
    return value if math.isfinite(value) else 0.0


def _coefficient(
    which: Callable[[NDArray[np.float64], NDArray[np.float64]], float],
    printed: NDArray[np.float64],  # [K]
    scores: NDArray[np.float64],  # [K, n]
    level: float,
) -> Coefficient:
    def of_replicates(means: NDArray[np.float64]) -> NDArray[np.float64]:  # [K, R] -> [R]
        from scipy import stats

        # thousands of replicates have few orders between them
        orders, number = np.unique(stats.rankdata(means, axis=0), axis=1, return_inverse=True)
        return np.array([which(printed, order) for order in orders.T])[number.reshape(-1)]

    value = which(printed, scores.mean(1))
    if scores.shape[1] < 2:
        return Coefficient(value, math.nan, math.nan)
    low, high = cluster_bootstrap(scores, level, statistic=of_replicates).tolist()
    return Coefficient(value, low, high)


def better_than(
    own: str,
    scores: Mapping[str, Mapping[str, float]],  # system -> person -> score in one region
    higher_is_better: bool,
) -> Sequence[tuple[str, dict[str, float]]]:
    """Systems whose mean over common people is better than that of `own`, with the differences, theirs minus its."""
    sign = 1 if higher_is_better else -1
    out = []
    for system, by_person in scores.items():
        common = sorted(set(by_person) & set(scores.get(own, {})))
        differences = {person: by_person[person] - scores[own][person] for person in common}
        if system != own and common and sign * math.fsum(differences.values()) > 0:
            out.append((system, differences))
    return out
