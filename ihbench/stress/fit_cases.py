"""Stiff training that is asked of every method whose fit holds alpha to the visible person: few steps, the person of
six small frames, and everything that goes wrong. A method names its fit, its smallest configuration and its rates."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ihbench.clock.ledger import Ledger
from ihbench.errors import BadInput
from ihbench.scene.contracts import MaskState, TrainingSet, TrainView
from ihbench.stress.case import Answer, Case, Unit, words_of
from ihbench.stress.six_views import (
    all_unknown,
    training_set,
    views,
    with_bad_hidden_pixels,
    with_bad_pixel,
    with_other_shapes,
)
from ihbench.stress.training import story_of_fit

Config = Any  # of a method: a frozen dataclass

HELPS = "the error of alpha over the views after the fit, over that before: a fit that does not lower it is none"
STEP = "a step is counted"
PRUNED = "an opacity of 1 is asked of every Gaussian"
OTHER_SHAPES = "shape coefficients that differ by frame"
REFUSED = "it must be refused, and the line must say this"


@dataclass(frozen=True)
class FitCases:
    """Cases of one method, by what becomes of its fits. A note says which steps the guard rejected and where it went
    back to."""

    method: str
    tiny: Config
    rates: tuple[str, ...]  # switches that are step sizes
    fit: Callable[[Config, TrainingSet, Ledger], Any]
    start: Callable[[Config, TrainingSet], Any]  # the avatar before the fit

    def story(self, config: Config, training: TrainingSet | None = None) -> tuple[Any, str]:
        """The avatar, None where it diverged, and what happened on the way."""
        ledger = Ledger()
        return story_of_fit(lambda: self.fit(config, training or training_set(), ledger), ledger)

    def ratio(self, config: Config, training: TrainingSet | None = None) -> Answer:
        """Error of alpha after over that before."""
        training = training or training_set()
        after, what = self.story(config, training)
        before = error_of_alpha(self.start(config, training), training)
        return Answer(math.nan if after is None else error_of_alpha(after, training) / before, 1.0, note=what)

    def scaled(self, factor: float) -> Config:
        config = replace(self.tiny)
        for name in self.rates:  # past the switches' bounds: the guard of a fit must hold whatever reaches it
            object.__setattr__(config, name, factor * getattr(self.tiny, name))
        return config

    def survives(self, factor: float) -> Answer:
        """Either the fit ends with a finite avatar, or it is a divergence with its first bad step: never a crash,
        never NaN in a picture."""
        after, what = self.story(self.scaled(factor))
        if after is None:
            return Answer(what, "diverged, first bad step")
        rgb, alpha = after.render(views()[0].camera, views()[0].body_pose, frame=views()[0].frame)
        return Answer(f"finite {bool(np.isfinite(rgb).all() and np.isfinite(alpha).all())}: {what}", "finite True")

    def empty_masks(self, config: Config) -> Answer:
        """Views in which the person is wholly hidden, among others."""
        return self.ratio(config, training_set([views()[0], *all_unknown()[1:3], *views()[3:]]))

    def nothing(self, shown: Sequence[TrainView]) -> Answer:
        refused = words_of(BadInput, lambda: self.fit(self.tiny, training_set(shown), Ledger()))
        return Answer(refused, "nothing to fit")

    def bad_pixel(self, bad: float) -> Answer:
        """One pixel of one view is not finite; smaller steps cannot help, so none is tried."""
        after, what = self.story(self.tiny, with_bad_pixel(2, bad))
        assert after is None
        return Answer(what, "loss is ")

    def hidden_bad_pixel(self) -> Answer:
        """A NaN behind the occluder is nobody's business."""
        return self.ratio(self.tiny, with_bad_hidden_pixels(1, math.nan))

    def case(self, name: str, what: str, function: Callable[[], Answer], unit: Unit, why: str) -> Case:
        return Case(f"{self.method}-{name}", what, function, unit, 0, why, "training")

    def helps(self, name: str, what: str, function: Callable[[], Answer]) -> Case:
        return self.case(name, what, function, "at most", HELPS)

    def ignoring(self) -> list[Case]:
        """Of a method that takes hidden pixels for background unless it is told to ignore them: when it is."""
        config, how = replace(self.tiny, unknown="ignore"), "hidden pixels are ignored"
        empty, bad = f"two frames without a visible pixel, {how}", f"NaN behind the occluder, {how}"
        return [
            self.helps("empty-mask-ignored", empty, lambda: self.empty_masks(config)),
            self.helps("nan-hidden-ignored", bad, lambda: self.ratio(config, with_bad_hidden_pixels(1, math.nan))),
        ]

    def resumed(
        self,
        stage: Callable[[Any, TrainingSet, Ledger], Any],  # the fit of a fresh avatar
        fresh: Callable[[Config, TrainingSet], Any] | None = None,  # else `start`
        config: Config | None = None,  # else `tiny`
    ) -> Case:
        """Killed and gone on with: the same bits as without."""

        def changed() -> Answer:
            from ihbench.stress.resuming import changed_by_a_kill

            training, own = training_set(), config or self.tiny
            whole, _ = self.story(own, training)
            assert whole is not None
            begin = fresh or self.start
            return Answer(
                changed_by_a_kill(
                    lambda: begin(own, training), lambda avatar, ledger: stage(avatar, training, ledger), whole
                ),
                0,
            )

        return self.case("resumed", "killed and gone on with", changed, "absolute", "what continues is the same fit")

    def usual(
        self, normal: Config, unseen: Config, pruned: Config | None, factors: Sequence[float] = (100.0, 1e4, 1e30)
    ) -> list[Case]:
        """Those that each method has: `normal` is its configuration with nothing left out, `unseen` one that leaves
        hidden pixels alone, `pruned` one under which no Gaussian may stay, None where that cannot be."""
        step: tuple[Unit, str] = ("words", STEP)
        refused: tuple[Unit, str] = ("words", REFUSED)
        return [
            self.helps("rate-1", "step sizes as they are", lambda: self.ratio(normal)),
            *(
                self.case(
                    f"rate-{factor:g}", f"step sizes × {factor:g}", lambda factor=factor: self.survives(factor), *step
                )
                for factor in factors
            ),
            self.helps("other-shapes", OTHER_SHAPES, lambda: self.ratio(self.tiny, with_other_shapes())),
            self.helps("one-frame", "one training frame", lambda: self.ratio(self.tiny, training_set(views()[:1]))),
            self.helps("empty-mask", "two frames without a visible pixel", lambda: self.empty_masks(unseen)),
            self.case("no-view", "no training view", lambda: self.nothing([]), *refused),
            self.case("all-hidden", "views without a visible pixel", lambda: self.nothing(all_unknown()), *refused),
            *([] if pruned is None else [self.case(
                "all-pruned", PRUNED, lambda: Answer(self.story(pruned)[1], "would prune all of"), *step,
            )]),
            self.case("nan-pixel", "a NaN among the person's pixels", lambda: self.bad_pixel(math.nan), *step),
            self.case("inf-pixel", "an infinite person pixel", lambda: self.bad_pixel(math.inf), *step),
            self.helps("nan-hidden", "NaN behind the occluder", self.hidden_bad_pixel),
        ]  # fmt: skip


def error_of_alpha(avatar: Any, training: TrainingSet) -> float:
    """Mean squared, where it is known whether the person is there."""
    errors = []
    for view in training.views:
        alpha = avatar.render(view.camera, view.body_pose, frame=view.frame)[1]
        known = view.mask != MaskState.UNKNOWN
        errors.append(np.square(alpha - (view.mask == MaskState.PERSON))[known])
    return float(np.concatenate(errors).mean())
