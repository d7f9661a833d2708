"""Stiff training: what is asked of any method, and how a case states what became of a fit.

A method brings its own cases: a list of them, named in its `MethodSpec.stress`. This one has the cases
that need none, of the pieces that every fit here is made of.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from ihbench.camera import Camera
from ihbench.clock.events import RolledBack
from ihbench.clock.ledger import Ledger
from ihbench.errors import Diverged
from ihbench.stress.case import Answer, Case
from ihbench.stress.splat import camera

if TYPE_CHECKING:
    from torch import Tensor


def story_of_fit(fit: Callable[[], Any], ledger: Ledger) -> tuple[Any, str]:
    """What a fit gave (None for a divergence), and its story in words: every rejected step and where it went back to,
    or "no step rejected", and the first bad step of a divergence."""
    try:
        fitted, end = fit(), ""
    except Diverged as outcome:
        fitted, end = None, f"diverged, first bad step {outcome.step}: {outcome.reason}"
    back = [
        f"step {data['bad_step']} rejected, back to {data['step']}" if "bad_step" in data else str(data["what"])
        for data in (event.data for event in ledger.events if event.kind == RolledBack.kind)
    ]
    story = "; ".join(back) if back else "" if end else "no step rejected"
    return fitted, "; ".join(part for part in (story, end) if part)


def _pull(shift: float) -> float:
    """Of the squared error of a black Gaussian `shift` m beside where it should be, along x."""
    mean, loss = _moved(shift, camera(80, 20))
    loss().backward()
    assert mean.grad is not None
    return float(mean.grad[0, 0])


def _moved(shift: float, view: Camera) -> tuple[Tensor, Callable[[], Tensor]]:
    """The centre [1, 3] of a black Gaussian `shift` m beside where it should be, and its squared error."""
    import torch

    from ihbench.render.splat import render_gaussians

    mean = torch.tensor([[shift, 0.0, 2.0]], requires_grad=True)
    scale, color = torch.tensor([0.1]), torch.zeros(1, 3)
    target = render_gaussians(torch.tensor([[0.0, 0.0, 2.0]]), scale, color, view)[0]
    return mean, lambda: (render_gaussians(mean, scale, color, view)[0] - target).square().mean()


def _apart() -> Answer:
    """A footprint ends where alpha is 1/255: beyond two of them no pixel pulls, and a fit from there is stuck."""
    return Answer(_pull(0.9) / _pull(0.1), 0.0, math.inf)


def _close() -> Answer:
    """Gradient descent from half a footprint away arrives."""
    import torch

    mean, loss = _moved(0.1, camera())
    optimizer = torch.optim.Adam([mean], lr=0.01)
    for _ in range(60):
        optimizer.zero_grad()
        loss().backward()
        optimizer.step()
    return Answer(float(mean.detach()[0, 0]), 0.0)


CASES = [
    Case("descent-close", "one Gaussian moved onto another, 2 px away", _close, "absolute", 0.01,
         "m; Adam's step size", "training"),
    Case("descent-apart", "the pull between two Gaussians that do not touch", _apart, "absolute", 1e-2,
         "relative to that of two that do; where pixels sample a footprint its sum is not quite constant",
         "training"),
]  # fmt: skip
