"""Stiff training of 3DGS-Avatar: few steps, a person of six small frames, and everything that goes wrong.

Named in the spec. A case's note says which steps the guard rejected and where it went back to.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.errors import BadInput
from ihbench.methods.three_dgs_avatar.config import SMOKE, ThreeDgsAvatarConfig
from ihbench.methods.three_dgs_avatar.method import ThreeDgsAvatarMethod
from ihbench.scene.contracts import MaskState, TrainingSet, TrainView
from ihbench.stress.case import Answer, Case, words_of
from ihbench.stress.resuming import changed_by_a_kill
from ihbench.stress.six_views import (
    all_unknown,
    training_set,
    views,
    with_bad_hidden_pixels,
    with_bad_pixel,
)
from ihbench.stress.training import story_of_fit

# all of the schedule in 18 steps, but for a reset, which so few do not outlive
TINY = replace(
    SMOKE,
    steps=18,
    points=800,
    surface_samples=128,
    warm_up=60,
    hash_size=8,
    hash_finest=32,
    gaussians_from=2,
    non_rigid_from=6,
    poses_from=10,
    neighbours_every=6,
    density=replace(SMOKE.density, after=8, before=17, every=6, resets=()),
    lr_opacity=0.4,
)
RATES = ("lr_position", "lr_feature", "lr_opacity", "lr_scale", "lr_rotation",
         "lr_skinning", "lr_non_rigid", "lr_colour", "lr_poses")  # fmt: skip

HELPS = "the error of alpha over the views after the fit, over that before: a fit that does not lower it is none"
STEP = "a step is counted"
REFUSED = "it must be refused, and the line must say this"
EXACT = "what continues is the same fit"


def fit(config: ThreeDgsAvatarConfig, training: TrainingSet | None = None, ledger: Ledger | None = None) -> Any:
    return ThreeDgsAvatarMethod(config).fit(
        training or training_set(), device="cpu", seed=0, ledger=ledger or Ledger(), progress=Progress.silent()
    )


def story(config: ThreeDgsAvatarConfig, training: TrainingSet | None = None) -> tuple[Any, str]:
    """The avatar, None where it diverged, and what happened on the way."""
    ledger = Ledger()
    return story_of_fit(lambda: fit(config, training, ledger), ledger)


def fresh(config: ThreeDgsAvatarConfig, training: TrainingSet) -> Any:
    """The avatar that a fit begins with."""
    from ihbench.methods.three_dgs_avatar.avatar import ThreeDgsAvatar
    from ihbench.methods.three_dgs_avatar.frame_tables import TrainingPoses

    betas = training.views[0].body_pose.betas
    return ThreeDgsAvatar(config, training.body, betas, TrainingPoses.of(training.views), 0)


def error_of_alpha(avatar: Any, training: TrainingSet) -> float:
    """Mean squared, where it is known whether the person is there."""
    errors = []
    for view in training.views:
        alpha = avatar.render(view.camera, view.body_pose, frame=view.frame)[1]
        known = view.mask != MaskState.UNKNOWN
        errors.append(np.square(alpha - (view.mask == MaskState.PERSON))[known])
    return float(np.concatenate(errors).mean())


def _ratio(config: ThreeDgsAvatarConfig, training: TrainingSet | None = None) -> Answer:
    """Error after over error before."""
    training = training or training_set()
    after, what = story(config, training)
    before = error_of_alpha(fresh(config, training), training)
    return Answer(math.nan if after is None else error_of_alpha(after, training) / before, 1.0, note=what)


def scaled_rates(factor: float) -> ThreeDgsAvatarConfig:
    config = replace(TINY)
    for name in RATES:  # past the switches' bounds: the guard of a fit must hold whatever reaches it
        object.__setattr__(config, name, factor * getattr(TINY, name))
    return config


def _survives(factor: float) -> Answer:
    """Either the fit ends with a finite avatar, or it is a divergence with its first bad step: never a crash, never
    NaN in a picture."""
    after, what = story(scaled_rates(factor))
    if after is None:
        return Answer(what, "diverged, first bad step")
    rgb, alpha = after.render(views()[0].camera, views()[0].body_pose, frame=views()[0].frame)
    return Answer(f"finite {bool(np.isfinite(rgb).all() and np.isfinite(alpha).all())}: {what}", "finite True")


def _empty_mask(**changes: Any) -> Answer:
    """Views in which the person is wholly hidden, among others."""
    return _ratio(replace(TINY, **changes), training_set([views()[0], *all_unknown()[1:3], *views()[3:]]))


def _nothing(shown: Sequence[TrainView]) -> Answer:
    return Answer(words_of(BadInput, lambda: fit(TINY, training_set(shown))), "nothing to fit")


def _all_pruned() -> Answer:
    return Answer(story(replace(TINY, density=replace(TINY.density, faint=1.0)))[1], "would prune all of")


def _bad_pixel(bad: float) -> Answer:
    """One pixel of one view is not finite; smaller steps cannot help, so none is tried."""
    after, what = story(TINY, with_bad_pixel(2, bad))
    assert after is None
    return Answer(what, "loss is ")


def _hidden_bad_pixel(unknown: Any) -> Answer:
    """A NaN behind the occluder is nobody's business."""
    return _ratio(replace(TINY, unknown=unknown), with_bad_hidden_pixels(1, math.nan))


def _one_gaussian() -> Answer:
    """A single Gaussian has no neighbour to keep its distance from."""
    config = replace(TINY, points=1, density=replace(TINY.density, faint=None))
    avatar, what = story(config)
    return Answer(f"{0 if avatar is None else len(avatar)} left: {what}", "no step rejected")


def _other_shapes() -> Answer:
    """Shape coefficients that differ by frame: one avatar, with their mean."""
    shown = [
        replace(view, body_pose=replace(view.body_pose, betas=np.array([0.5 * (-1) ** k, 0.0])))
        for k, view in enumerate(views())
    ]
    return _ratio(TINY, training_set(shown))


def _resumed() -> Answer:
    """Killed after a change of the set and with all parts on, and gone on with: the same bits as without."""
    from ihbench.methods.three_dgs_avatar.fitting import ThreeDgsAvatarFit

    training = training_set()
    whole, _ = story(TINY, training)
    assert whole is not None
    changed = changed_by_a_kill(
        lambda: fresh(TINY, training), lambda avatar, ledger: ThreeDgsAvatarFit(avatar, training, 0, ledger), whole
    )
    return Answer(changed, 0)


def _training(
    name: str, what: str, function: Callable[[], Answer], unit: Any, why: str, tolerance: float = 0
) -> Case:
    return Case(f"three-dgs-avatar-{name}", what, function, unit, tolerance, why, "training")


_helps = partial(_training, unit="at most", why=HELPS)
_step = partial(_training, unit="words", why=STEP)
_refused = partial(_training, unit="words", why=REFUSED)

CASES = [
    _helps("rate-1", "step sizes as they are", lambda: _ratio(TINY)),
    *(
        _step(f"rate-{factor:g}", f"step sizes × {factor:g}", partial(_survives, factor))
        for factor in (100.0, 1e4, 1e30)
    ),
    _helps("one-frame", "one training frame", lambda: _ratio(TINY, training_set(views()[:1]))),
    *(
        _helps(f"empty-mask-{unknown}", f"two frames without a visible pixel, unknown pixels are {unknown}",
               partial(_empty_mask, unknown=unknown))
        for unknown in ("background", "ignore")
    ),
    _refused("no-view", "no training view", partial(_nothing, [])),
    _refused("all-hidden", "views without a visible pixel", lambda: _nothing(all_unknown())),
    _step("all-pruned", "an opacity of 1 is asked of every Gaussian", _all_pruned),
    _step("nan-pixel", "a NaN among the person's pixels", partial(_bad_pixel, math.nan)),
    _step("inf-pixel", "an infinite person pixel", partial(_bad_pixel, math.inf)),
    *(
        _helps(f"nan-hidden-{unknown}", f"NaN behind the occluder, unknown pixels are {unknown}",
               partial(_hidden_bad_pixel, unknown))
        for unknown in ("background", "ignore")
    ),
    _helps("other-shapes", "shape coefficients that differ by frame", _other_shapes),
    _step("one-gaussian", "a single Gaussian", _one_gaussian),
    _training("resumed", "killed and gone on with", _resumed, "absolute", EXACT),
]  # fmt: skip
