"""Stiff training of GaussianAvatar: the smallest avatar, a person of six small frames, and what goes wrong."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.errors import BadInput
from ihbench.methods.gaussianavatar.avatar import TexelAvatar
from ihbench.methods.gaussianavatar.config import SMOKE, GaussianAvatarConfig
from ihbench.methods.gaussianavatar.method import GaussianAvatar
from ihbench.methods.gaussianavatar.stages import Stage1
from ihbench.scene.contracts import MaskState, TrainingSet
from ihbench.stress.case import Answer, Case, Unit, words_of
from ihbench.stress.drawn_capture import WHITE, the_body
from ihbench.stress.resuming import changed_by_a_kill
from ihbench.stress.six_views import (
    all_unknown,
    only_a_pixel,
    training_set,
    views,
    with_bad_hidden_pixels,
    with_bad_pixel,
    with_other_shapes,
)
from ihbench.stress.training import story_of_fit

STEPS = 24
TINY = replace(SMOKE, texels=32, feature_map=16, channels=8, width=16, steps=STEPS, scale_ramp=4, lpips=0.0)
RATES = ("lr_network", "lr_features")

HELPS = "the error of the pictures after the fit, over that of plain background: a person is better than none"
NO_WORSE = "absurd step sizes may leave nothing but background, which is as bad as no fit, and no worse"
STEP = "a step is counted"
REFUSED = "it must be refused, and the line must say this"
EXACT = "not a bit may change"


def scaled_rates(factor: float) -> GaussianAvatarConfig:
    config = replace(TINY)
    for name in RATES:  # past the switches' bounds: the guard of a fit must hold whatever reaches it
        object.__setattr__(config, name, factor * getattr(TINY, name))
    return config


def fresh(config: GaussianAvatarConfig) -> TexelAvatar:
    return TexelAvatar(config, the_body(), np.zeros(10), 0)


def fitted(config: GaussianAvatarConfig, training: TrainingSet | None = None) -> tuple[TexelAvatar | None, str]:
    """The avatar after a fit to all views or to these, None where it diverged, and what happened on the way."""
    ledger, method = Ledger(), GaussianAvatar(config)

    def fit() -> TexelAvatar:
        return method.fit(training or training_set(), device="cpu", seed=0, ledger=ledger, progress=Progress.silent())

    return story_of_fit(fit, ledger)


def _ratio(config: GaussianAvatarConfig, training: TrainingSet | None = None) -> Answer:
    """Absolute error of pictures of the person, where they are fitted, over that of the background alone."""
    training = training or training_set()
    avatar, story = fitted(config, training)
    if avatar is None:
        return Answer(math.nan, 1.0, note=story)
    after = before = 0.0
    for view in training.views:
        person = view.mask == MaskState.PERSON
        image = view.image[person].astype(np.float64) / 255
        after += np.abs(avatar.render(view.camera, view.body_pose)[0][person] - image).sum()
        before += np.abs(np.asarray(WHITE) - image).sum()
    return Answer(after / before, 1.0, note=story)


def _absurd_rates() -> Answer:
    """1e30 times too large: nothing can be saved, and the record says so."""
    after, story = fitted(scaled_rates(1e30))
    assert after is None
    return Answer(story, "diverged, first bad step 1")


def _nothing(training: TrainingSet) -> Answer:
    return Answer(words_of(BadInput, lambda: fitted(TINY, training)), "nothing to fit")


def _bad_pixel(bad: float) -> Answer:
    """One pixel of one view is not finite. Its first step is known; smaller steps cannot help, so none is tried."""
    training = with_bad_pixel(2, bad)
    stage = Stage1(fresh(TINY), training, 0, Ledger())
    first = next(step for step in range(6) if stage.batch_of(stage._view_of(step, 6)) == [2])
    after, story = fitted(TINY, training)
    assert after is None
    return Answer(story, f"diverged, first bad step {first}: loss is ")


def _hidden_bad_pixels(unknown: Any) -> Answer:
    """NaN behind the occluder is nobody's business."""
    return _ratio(replace(TINY, unknown=unknown), with_bad_hidden_pixels(1, math.nan))


def _resumed() -> Answer:
    """Killed, and gone on with from the state of step 11: the same bits as without."""
    whole, _ = fitted(TINY)
    assert whole is not None
    training = training_set()
    return Answer(
        changed_by_a_kill(lambda: fresh(TINY), lambda avatar, ledger: Stage1(avatar, training, 0, ledger), whole), 0
    )


def _training(
    name: str, what: str, function: Callable[[], Answer], unit: Unit, tolerance: float, why: str, known: str = ""
) -> Case:
    return Case(f"gaussianavatar-{name}", what, function, unit, tolerance, why, "training", known)


_helps = partial(_training, unit="at most", tolerance=0, why=HELPS)
_step = partial(_training, unit="words", tolerance=0, why=STEP)
_refused = partial(_training, unit="words", tolerance=0, why=REFUSED)

CASES = [
    *(
        _helps(f"rate-{factor:g}", f"step sizes × {factor:g}", lambda factor=factor: _ratio(scaled_rates(factor)))
        for factor in (1.0, 10.0)
    ),
    _training("rate-100", "step sizes × 100", lambda: _ratio(scaled_rates(100.0)), "at most", 1e-3, NO_WORSE),
    _step("rate-1e30", "step sizes × 1e30", _absurd_rates),
    _helps("one-frame", "one training frame", lambda: _ratio(TINY, training_set(views()[:1]))),
    _helps("other-shapes", "shape coefficients that differ by frame", lambda: _ratio(TINY, with_other_shapes())),
    _helps("one-frame-batch", "one training frame, batches of two",
           lambda: _ratio(replace(TINY, batch=2), training_set(views()[:1]))),
    _refused("no-view", "no training view", lambda: _nothing(training_set([]))),
    _refused("all-hidden", "views without a visible pixel", lambda: _nothing(training_set(all_unknown()))),
    _training("empty-mask", "a view without a visible pixel among others",
              lambda: _ratio(TINY, training_set([*views()[:5], all_unknown()[5]])), "at most", 0, HELPS),
    _step("speck", "a view of one person pixel",
          lambda: Answer(fitted(TINY, training_set([*views()[:5], only_a_pixel(5, MaskState.BACKGROUND)]))[1],
                         "no step rejected")),
    _step("nan-pixel", "a NaN among the person's pixels", partial(_bad_pixel, math.nan)),
    _step("inf-pixel", "an infinite person pixel", partial(_bad_pixel, math.inf)),
    *(
        _helps(f"nan-hidden-{unknown}", f"NaN behind the occluder, unknown pixels are {unknown}",
               partial(_hidden_bad_pixels, unknown))
        for unknown in ("background", "ignore")
    ),
    _training("resumed", "killed and gone on with", _resumed, "absolute", 0, EXACT),
]  # fmt: skip
