"""What the doubts about predictions say, and that they are silent about honest ones."""

import re
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from ihbench.scoring.prediction_doubts import Doubts

WHITE = (1.0, 1.0, 1.0)
N, H, W = 8, 72, 64


def truths():
    """A textured person who walks from left to right, on white, seen in N frames."""
    random = np.random.default_rng(0)
    coarse = random.uniform(0.1, 0.9, (12, 5, 3)).astype(np.float32) * np.array([1.0, 0.6, 0.3], np.float32)
    person = cv2.resize(coarse, (20, 48), interpolation=cv2.INTER_CUBIC).clip(0, 1)
    for k in range(N):
        image, mask = np.ones((H, W, 3), np.float32), np.zeros((H, W), bool)
        area = slice(12, 60), slice(4 + 5 * k, 24 + 5 * k)
        image[area], mask[area] = person, True
        yield image, mask


def notes_of(change):
    """The notes on predictions that `change(k, image, mask)` makes of the truths."""
    doubts = Doubts(WHITE)
    for k, (image, mask) in enumerate(truths()):
        key, view = SimpleNamespace(name=f"cam/{k:06d}"), SimpleNamespace(image=image, silhouette=mask)
        doubts.look(SimpleNamespace(index=k, key=key, view=view), change(k, image, mask))
    return doubts.notes()


def noisy(image, mask, strength, seed=0):
    noise = np.random.default_rng(seed).normal(0, strength, image.shape).astype(np.float32)
    return (image + noise * mask[..., None]).clip(0, 1)


HONEST = {
    "the truth": lambda k, image, mask: image,
    "in 8 bits": lambda k, image, mask: np.rint(image * 255).astype(np.uint8),
    "noisy": lambda k, image, mask: noisy(image, mask, 0.3, k),
    "blurred": lambda k, image, mask: cv2.GaussianBlur(image, (0, 0), 2),
    "in one colour": lambda k, image, mask: np.where(mask[..., None], np.float32(0.4), image),
    "too bright": lambda k, image, mask: np.where(mask[..., None], image * 1.4, image).clip(0, 1),
    "too dark": lambda k, image, mask: np.where(mask[..., None], cv2.GaussianBlur(image, (0, 0), 1) * 0.5, image),
    "in one bright colour": lambda k, image, mask: np.where(mask[..., None], np.float32(0.7), image),
    "without legs": lambda k, image, mask: np.where((np.arange(H) > 35)[:, None, None], np.float32(1), image),
    "nobody": lambda k, image, mask: np.ones_like(image),
    "not a number": lambda k, image, mask: np.full_like(image, np.nan),
    "another size": lambda k, image, mask: image[:4],
    "one frame of another": lambda k, image, mask: LIST[1][0] if k == 0 else image,
    "errors at random": lambda k, image, mask: np.roll(image, (-1) ** k * 2, 1),
}
LIST = list(truths())
WRONG = {
    "BGR": (lambda k, image, mask: image[..., ::-1], "red and blue"),
    "mirrored": (lambda k, image, mask: image[:, ::-1], "mirrored"),
    "upside down": (lambda k, image, mask: image[::-1], "upside down"),
    "linear light": (lambda k, image, mask: noisy(image**2.2, mask, 0.02), "linear light"),
    "encoded twice": (lambda k, image, mask: image ** (1 / 2.2), "encoded twice"),
    "black background": (
        lambda k, image, mask: np.where(mask[..., None], image, 0),
        r"background \(0, 0, 0\), the protocol's is \(255",
    ),
    "half a pixel": (
        lambda k, image, mask: cv2.warpAffine(
            image, np.float32([[1, 0, 0.5], [0, 1, 0.5]]), (W, H), borderMode=cv2.BORDER_REPLICATE
        ),
        r"\+0\.[3-7] px right of and \+0\.[3-7] px below",
    ),
    "a frame late": (lambda k, image, mask: LIST[min(k + 1, N - 1)][0], "truth of another view.*numbered otherwise"),
    "backwards": (lambda k, image, mask: noisy(*LIST[N - 1 - k], 0.05), "truth of another view.*numbered otherwise"),
}


@pytest.mark.parametrize("kind", HONEST)
def test_honest_predictions_raise_no_doubt(kind):
    expected = ["predictions have the background (0, 0, 0), the protocol's is (255, 255, 255)"]
    assert notes_of(HONEST[kind]) == (expected if kind == "not a number" else [])


@pytest.mark.parametrize("kind", WRONG)
def test_what_is_wrong_with_all_predictions_is_said(kind):
    change, words = WRONG[kind]
    notes = notes_of(change)
    assert any(re.search(words, note) for note in notes), notes
    assert len(notes) == 1
