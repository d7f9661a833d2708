"""The sampler's rows in `ihbench kernels`: few steps against many."""

from __future__ import annotations

import pytest
import torch

from ihbench.kernels.sampler import hidden_middle, sampler_rows
from tests.diffusion.tiny_diffusion import CROP, same, tiny_backbone, weights


def test_as_many_steps_as_the_reference_differ_by_rounding_alone_and_fewer_by_more():
    backbone = tiny_backbone()
    before = weights(backbone.unet)
    rows = sampler_rows(1, steps=(1, 3, 6), many=6, given=backbone)
    assert [r.backend for r in rows] == ["1 steps", "3 steps", "6 steps"] * 2
    assert len({r.case for r in rows}) == 2
    for k in (0, 3):
        one, three, six = (r.value_error for r in rows[k : k + 3])
        assert six < 1e-4 < three
        assert six < 1e-4 < one
    assert backbone.dtype == torch.float32
    assert same(before, weights(backbone.unet))


def test_the_person_whose_middle_is_hidden_is_there():
    view = hidden_middle(CROP)
    assert view.hidden_share == pytest.approx(0.5, abs=0.25)
    assert view.person.any()
    assert not (view.person & view.unknown).any()
    assert not view.unknown[: CROP // 4].any()
    assert view.unknown[CROP // 2].all()
