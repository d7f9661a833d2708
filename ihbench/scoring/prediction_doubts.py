"""What makes a folder of predictions look mistaken rather than bad: things that a score alone would not show.

Each is said only where a simple change makes nearly all predictions fit their truth far better: red and blue
exchanged, mirrored, linear light, moved by a part of a pixel, the truth of other frames; and a background that is not
the protocol's. A weak avatar fits better after many a change: a curve is doubted only where it leaves next to
nothing and a mere brightness would leave more, a place only where moving explains a share of the error.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ihbench.metrics.images import Color, bounds, grown
from ihbench.scoring.scoring import LoadedView

FAR_BETTER = 0.5  # of the squared error, at most
CURVED = 0.1  # of it, at most, where a curve of brightness is exchanged: dark and pale avatars have such, too
MOST = 0.75  # share of the views that must agree
MOVED = 0.25  # px
EXPLAINED = 0.03  # share of the squared error, at least: a missing limb pulls the estimate of a shift, too
SAME = 1.5 / 255  # of a background's colour
LEAST_ERROR = 1e-5  # mean squared: closer than 50 dB nothing is doubted
LEAST_BACKGROUND = 100  # px
MARGIN = 4  # px around a person
SMALL = 32  # px, side of the pictures by which views are compared with each other
MOST_VIEWS = 1000  # that are compared with each other


def _encode(linear: NDArray) -> NDArray:
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)


def _decode(srgb: NDArray) -> NDArray:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((np.maximum(srgb, 0.04045) + 0.055) / 1.055) ** 2.4)


Change = Callable[[NDArray], NDArray]  # [H, W, 3] -> [H, W, 3]
TURNS: dict[str, Change] = {  # what would be wrong -> what undoes it, of whole images
    "mirrored left to right": lambda image: image[:, ::-1],
    "upside down": lambda image: image[::-1],
}
ENCODE = "encoded as sRGB: are they linear light?"
DECODE = "decoded from sRGB: were they encoded twice?"
COLOURS: dict[str, Change] = {  # and of any part of them
    "with red and blue exchanged: are they BGR?": lambda image: image[..., ::-1],
    ENCODE: _encode,
    DECODE: _decode,
}
CHANGES = (*TURNS, *COLOURS)


@dataclass(frozen=True)
class _Look:
    name: str
    error: float  # mean squared, in the rectangle of the person
    changed: tuple[float, ...]  # the same after each of CHANGES
    person: tuple[float, ...]  # see `_person_errors`
    moved: NDArray[np.float64]  # [2] px by which it lies right of and below the truth
    explained: float  # share of the squared error that this shift explains
    background: NDArray[np.float64] | None  # [3] in [0, 1], median where the truth shows only background
    truth: NDArray[np.float32]  # [3 * SMALL * SMALL]
    prediction: NDArray[np.float32]  # the same


class Doubts:
    """Collects predictions beside their truths. `look` may be called from any thread."""

    def __init__(self, background: Color):
        self._background = np.asarray(background, np.float64)
        self._looks: dict[int, _Look] = {}

    def look(
        self,
        loaded: LoadedView,
        image: NDArray,  # [H, W, 3] uint8, or float in [0, 1]
    ) -> None:
        """Take in the prediction of a view."""
        truth = loaded.view.image
        if image.shape != truth.shape:
            return
        image = np.nan_to_num(image / np.float32(255) if image.dtype == np.uint8 else image.astype(np.float32))
        image = np.clip(image, 0, 1)
        person = bounds(loaded.view.silhouette) or (slice(0, truth.shape[0]), slice(0, truth.shape[1]))
        rows, columns = grown(person, MARGIN, truth.shape)
        part, own = truth[rows, columns], image[rows, columns]
        changed = [change(image)[rows, columns] for change in TURNS.values()]
        changed += [change(own) for change in COLOURS.values()]
        errors = [float(np.square(one - part).mean()) for one in (own, *changed)]

        behind = (np.abs(truth - self._background) < SAME / 2).all(2)
        inside = loaded.view.silhouette[rows, columns]
        self._looks[loaded.index] = _Look(
            loaded.key.name,
            errors[0],
            tuple(errors[1:]),
            _person_errors(own[inside], part[inside]),
            *_moved(own.mean(2), part.mean(2)),
            np.median(image[behind], 0).astype(np.float64) if behind.sum() >= LEAST_BACKGROUND else None,
            _small(truth),
            _small(image),
        )

    def notes(self) -> list[str]:
        """A line for each thing that nearly all predictions have in common."""
        looks = [look for _, look in sorted(self._looks.items())]
        doubted = [look for look in looks if look.error > LEAST_ERROR]
        seen = [look.background for look in looks if look.background is not None]
        others = [not (np.abs(colour - self._background) <= 2 * SAME).all() for colour in seen]
        if seen and np.mean(others) >= MOST:
            said, meant = (
                ", ".join(f"{value * 255:.0f}" for value in colour)
                for colour in (np.median(np.stack(seen), 0), self._background)
            )
            return [f"predictions have the background ({said}), the protocol's is ({meant})"]  # spoils the rest
        if len(doubted) < max(1, MOST * len(looks)):
            return []
        likely = [*_changed(doubted), *_exchanged(doubted, looks)]
        return [min(likely)[1]] if likely else _shifted(doubted)


def _changed(looks: list[_Look]) -> Iterator[tuple[float, str]]:
    """(share of the error that is left, what it would mean) of each change that helps nearly everywhere."""
    errors = np.array([[look.error, *look.changed] for look in looks])  # [n, 1 + changes]
    better = (errors[:, 1:] < FAR_BETTER * errors[:, :1]).mean(0)
    left = errors.sum(0)[1:] / errors.sum(0)[0]
    as_it_is, encoded, decoded, brightened = np.sum([look.person for look in looks], axis=0)
    most = min(CURVED * as_it_is, FAR_BETTER * brightened)
    curves = {ENCODE: encoded, DECODE: decoded}
    for k, what in enumerate(CHANGES):
        if better[k] >= MOST and curves.get(what, 0.0) <= most:
            yield float(left[k]), f"predictions fit far better {what}"


def _exchanged(doubted: list[_Look], looks: list[_Look]) -> Iterator[tuple[float, str]]:
    """The same, where predictions fit the truths of other views."""
    looks = looks[:MOST_VIEWS]
    truths = np.stack([look.truth for look in looks]).astype(np.float64)
    sizes = np.square(truths).mean(1)
    own, nearest, pairs = 0.0, 0.0, []
    for look in doubted[:MOST_VIEWS]:
        image = look.prediction.astype(np.float64)
        errors = np.maximum(sizes - 2 * (truths @ image) / len(image) + np.square(image).mean(), 0)
        mine = float(np.square(look.truth - look.prediction).mean())
        own, nearest = own + mine, nearest + float(errors.min())
        if errors.min() < FAR_BETTER**2 * mine:
            pairs.append((look.name, looks[int(errors.argmin())].name))
    if len(pairs) >= MOST * len(looks):
        name, other = pairs[0]
        yield (
            nearest / own,
            f"{len(pairs)} predictions fit the truth of another view far better than their own ({name} that of "
            f"{other}): are frames or cameras numbered otherwise?",
        )


def _shifted(looks: list[_Look]) -> list[str]:
    moved = np.stack([look.moved for look in looks])
    middle = np.median(moved, 0)
    agreed = (np.abs(moved - middle) <= MOVED).all(1).mean() >= MOST
    explained = np.median([look.explained for look in looks]) >= EXPLAINED
    if np.abs(middle).max() <= MOVED or not agreed or not explained:
        return []
    return [
        f"predictions lie {middle[0]:+.1f} px right of and {middle[1]:+.1f} px below the truth: is a pixel's centre "
        f"elsewhere? (test_views.json says where)"
    ]


def _person_errors(image: NDArray, truth: NDArray) -> tuple[float, ...]:
    """Squared errors of a person's pixels [n, 3], summed: as they are, encoded, decoded, with the best brightness."""
    factor = float((image * truth).sum() / max(np.square(image).sum(), 1e-12))
    changed = image, _encode(image), _decode(image), np.minimum(image * factor, 1)
    return tuple(float(np.square(one - truth).sum()) for one in changed)


def _moved(image: NDArray, truth: NDArray) -> tuple[NDArray[np.float64], float]:
    """([2] the least-squares shift (right, down) of one grey image [H, W] against another, the share of the squared
    error that it explains); 0 where nothing tells."""
    difference = (truth - image).ravel().astype(np.float64)
    if min(truth.shape) < 2 or not difference.any():
        return np.zeros(2), 0.0
    down, right = np.gradient((image + truth) / 2)
    slopes = np.stack([right.ravel(), down.ravel()], 1).astype(np.float64)
    products = slopes.T @ difference
    solution = np.linalg.lstsq(slopes.T @ slopes, products, rcond=1e-6)[0]
    return np.asarray(solution, np.float64), float(solution @ products / np.square(difference).sum())


def _small(image: NDArray) -> NDArray[np.float32]:
    import cv2

    small = cv2.resize(image.astype(np.float32), (SMALL, SMALL), interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.float32).ravel()
