"""What is asked of each system of the paper's tables alike; `ihbench stress` asks more of each."""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from typing import Any

import numpy as np
import pytest

from ihbench.clock.events import Warned
from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.errors import BadInput
from ihbench.scene.contracts import MaskState, TrainView
from ihbench.scene.method_spec import method_spec, usable_specs

from .tiny_fit import equal_bits, everything, training_set

STRESS = {  # of those that make one shape of all frames'; others pose each frame by its own
    "gaussianavatar": "gaussianavatar.stress",
    "gtu": "gtu.stress",
    "humannerf": "humannerf.stress",
    "inpainthuman": "inpainthuman.studies.stress",
    "occnerf": "occnerf.stress",
    "three-dgs-avatar": "three_dgs_avatar.stress",
    "wild2avatar": "wild2avatar.stress",
}
SYSTEMS = [spec.name for spec in usable_specs() if spec.paper is not None]


def fit(method: str, config: Any, views: list[TrainView], ledger: Ledger) -> Any:
    return (
        method_spec(method)
        .create(config)
        .fit(training_set(views), device="cpu", seed=0, ledger=ledger, progress=Progress.silent())
    )


def test_the_ten_systems_are_asked():
    assert len(SYSTEMS) >= 10
    assert set(STRESS) < set(SYSTEMS)


@pytest.mark.parametrize("method", SYSTEMS)
def test_without_views_or_a_person_nothing_is_begun(method, views):
    config, ledger = method_spec(method).profile("paper"), Ledger()
    with pytest.raises(BadInput, match="scene tiny: no training view; nothing to fit"):
        fit(method, config, [], ledger)
    hidden = [replace(view, mask=np.full_like(view.mask, MaskState.UNKNOWN)) for view in views]
    with pytest.raises(BadInput, match="no training view shows a visible person pixel; nothing to fit"):
        fit(method, config, hidden, ledger)
    assert not [row for row in ledger.table() if row["stage"].startswith("fit")]


@pytest.mark.parametrize("method", STRESS)
def test_shapes_that_differ_by_frame_become_their_mean_and_are_said(method, views):
    config = replace(import_module(f"ihbench.methods.{STRESS[method]}").TINY, steps=1)
    betas = [np.array([b, 0.0]) for b in (-1.0, 0.0)]
    shown = [replace(v, body_pose=replace(v.body_pose, betas=b)) for v, b in zip(views[:2], betas, strict=True)]
    ledger = Ledger()
    avatar = fit(method, config, shown, ledger)
    assert np.array(avatar.betas).tolist() == [-0.5, 0.0]
    said = [event.data["what"] for event in ledger.events if event.kind == Warned.kind]
    assert sum("shape coefficients vary over the frames" in what for what in said) == 1


@pytest.mark.parametrize("method", SYSTEMS)
def test_a_finished_fit_gone_on_with_is_the_same(method, views):
    """Killed after its last step, while its avatar was saved or scored, a fit begins again and has nothing to do."""
    package = method.replace("-", "_").replace("occgauhuman", "gauhuman")
    stress = import_module(f"ihbench.methods.{STRESS.get(method, package + '.stress')}")
    config, ledger = stress.OCCLUDED_ONES.tiny if method == "occgauhuman" else stress.TINY, Ledger()
    first, again = (fit(method, config, views, ledger) for _ in range(2))
    assert equal_bits(everything(first), everything(again))
    for one, other in zip(
        *(a.render(views[0].camera, views[0].body_pose, frame=0) for a in (first, again)), strict=True
    ):
        assert np.array_equal(one, other)
