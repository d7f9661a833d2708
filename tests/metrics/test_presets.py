"""Every preset against the released evaluator restated with its own libraries, and a check that can fail."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ihbench import registry
from ihbench.metrics import evaluate, lpips
from ihbench.metrics.evaluate import find_preset
from ihbench.metrics.oracles import check as checking
from ihbench.metrics.oracles.cases import person_case
from ihbench.metrics.oracles.check import mismatches
from tests.metrics.released import RELEASED

NAMES = ["ihbench", "neuralbody", "humannerf", "occnerf", "gauhuman", "3dgs-avatar-zju", "instantavatar", "gtu-mask"]
MEASURES = [(name, k) for name in NAMES for k in range(len(find_preset(name).measures))]


def scores(case, preset, **options):
    asked = [name for name in case.regions if "+" not in name]
    return evaluate(case.pred, case.truth, case.regions, preset, over=asked, slow=False, **options)


def test_all_of_them_are_registered():
    assert set(registry.names("metric preset")) >= set(NAMES)
    assert all(find_preset(name).source for name in NAMES)


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.uint8])
@pytest.mark.parametrize("name", NAMES)
def test_a_preset_is_the_released_evaluator(name, dtype):
    case = person_case(48, 40, dtype=dtype)
    found = scores(case, name)
    restated = RELEASED[name](case.pred, case.truth, case.regions)
    assert {identity for identity in found if not identity.startswith("flip")} == set(restated)
    for identity, value in restated.items():
        assert found[identity].value == pytest.approx(float(value), abs=1e-7), identity


def test_no_two_presets_share_an_identity():
    case = person_case()
    found = [identity for name in NAMES for identity in scores(case, name)]
    assert len(found) == len(set(found))


@pytest.mark.parametrize("name", ["neuralbody", "humannerf", "gauhuman", "gtu-mask"])
def test_a_region_that_is_not_given_is_a_reason(name):
    case = person_case()
    found = evaluate(case.pred, case.truth, {"full": None}, name, slow=False)
    assert found
    assert all("was not given" in score.reason for score in found.values())


@pytest.fixture
def one_case(monkeypatch):
    """The check's oracle comparisons on one image pair and background."""
    monkeypatch.setattr(checking, "_cases", lambda: [person_case()])
    monkeypatch.setattr(checking, "BACKGROUNDS", {"": (1.0, 1.0, 1.0)})


@pytest.fixture(scope="module")
def networks():
    with lpips.random_networks() as found:
        yield found


@pytest.mark.parametrize(("name", "k"), MEASURES)
def test_the_check_fails_when_a_measure_is_off_by_a_ten_thousandth(name, k, one_case, networks):
    preset = find_preset(name)
    measure = preset.measures[k]

    def off(frame, mask):
        value = measure.compute(frame, mask)
        return value * (1 + 1e-4) if isinstance(value, float) else value

    others = list(preset.measures)
    metric = measure.identity("full", (1.0, 1.0, 1.0))
    found = list(checking._against_oracles([replace(preset, measures=(measure,))], networks))
    assert [c for c in mismatches(found) if c.metric.startswith(f"{metric.metric}/{metric.variant}/")] == []
    others[k] = replace(measure, compute=off)
    found = list(checking._against_oracles([replace(preset, measures=(others[k],))], networks))
    off_ones = [c for c in mismatches(found) if c.metric.startswith(f"{metric.metric}/{metric.variant}/")]
    assert off_ones
    assert all(np.isfinite(c.ours) and np.isfinite(c.theirs) for c in off_ones)


@pytest.mark.parametrize("constant", ["K2"])
def test_the_check_fails_when_a_constant_of_ssim_is_off(constant, one_case, networks, monkeypatch):
    import sys

    module = sys.modules["ihbench.metrics.ssim"]
    monkeypatch.setattr(module, constant, getattr(module, constant) * (1 + 1e-4))
    preset = find_preset("ihbench")
    ssim_only = replace(
        preset, measures=tuple(m for m in preset.measures if "ssim" in str(m.identity("full", (1, 1, 1))))
    )
    found = [c for c in checking._against_oracles([ssim_only], networks) if c.metric.startswith("ssim")]
    assert mismatches(found)


def test_stored_values_and_libraries_agree():
    found = [*checking._against_stored([find_preset(name) for name in NAMES]), *checking._against_libraries()]
    assert mismatches(found) == []
    assert {c.reference.split()[0] for c in found} >= {
        "stored",
        "scikit-image",
        "torchmetrics",
        "kornia",
        "flip-evaluator",
    }


def test_lpips_is_the_packages_on_the_same_trunk(networks):
    found = list(checking._lpips_against_package(networks))
    assert len(found) == 6
    assert mismatches(found) == []
