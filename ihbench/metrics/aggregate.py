"""From frames to a subject, from subjects to a data set. Absent and infinite numbers are counted, never hidden."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from ihbench.metrics.identity import Score

LARGEST = 1e100  # a metric's value beyond it is damage; sums and squares of smaller ones stay finite


@dataclass(frozen=True)
class Mean(Score):
    """The mean of `n` finite numbers, and how many were left out of it."""

    n: int = 0  # numbers the mean runs over
    infinite: int = 0  # +inf: a PSNR without any error
    absent_count: int = 0  # NaN

    @property
    def note(self) -> str:
        """What a table must say beside the number; "" when nothing was left out."""
        parts = []
        if self.infinite and self.n:
            parts.append(f"{self.infinite} of {self.total} without any error (inf) left out")
        if self.absent_count and not self.absent:
            parts.append(f"{self.absent_count} of {self.total} absent: {self.reason}")
        return "; ".join(parts)

    @property
    def total(self) -> int:
        return self.n + self.infinite + self.absent_count


def mean_over_frames(scores: Iterable[Score]) -> Mean:
    """The arithmetic mean over one subject's frames, all of one identity.

    Infinite numbers (PSNR of identical images) are left out and counted; if nothing else is there, the mean is inf.
    Absent numbers are left out and counted; `reason` is the commonest reason among them. Nothing but absent numbers
    give an absent mean. -inf and finite numbers beyond `LARGEST` are no metric's values and count as absent. Raises
    `ValueError` for identities that differ and for no scores at all.
    """
    scores = list(scores)
    identities = sorted({score.identity for score in scores})
    if len(identities) != 1:
        raise ValueError(f"mean: expected scores of one identity, got {', '.join(identities) or 'no scores'}")
    finite = [score.value for score in scores if abs(score.value) <= LARGEST]
    infinite = sum(score.value == math.inf for score in scores)
    reasons = Counter(
        score.reason if score.absent else f"{score.value:g} is no metric's value"
        for score in scores
        if score.absent or (abs(score.value) > LARGEST and score.value != math.inf)
    )
    reason = reasons.most_common(1)[0][0] if reasons else ""
    if finite:
        value = math.fsum(finite) / len(finite)
    else:
        value = math.inf if infinite else math.nan
    return Mean(value, identities[0], reason, len(finite), infinite, sum(reasons.values()))


def macro_mean(per_subject: Mapping[str, Score]) -> Mean:
    """The mean over subjects, each counted once however many frames it has.

    `n` counts subjects. Those with an infinite or absent number are left out and counted as `mean_over_frames` does
    with frames. Raises `ValueError` as it does.
    """
    return mean_over_frames(per_subject.values())
