"""The precision of a fit's networks: measured, or as asked for."""

import pytest
import torch

from ihbench.fit import precision


@pytest.mark.parametrize(
    ("speed", "expected"), [(0.05, "float32"), (1.2, "float32"), (1.3, "bfloat16"), (9, "bfloat16")]
)
def test_bfloat16_must_pay(monkeypatch, speed, expected):
    monkeypatch.setattr(precision, "bfloat16_speed", lambda device: speed)
    computed = precision.choose("auto", "cpu")
    assert computed.precision == expected
    assert f"{speed:.1f} times" in computed.reason
    assert precision.choose("float32", "cpu").precision == "float32"
    assert precision.choose("bfloat16", "cpu").precision == "bfloat16"


def test_the_measurement_gives_a_ratio():
    assert 0 < precision.bfloat16_speed("cpu") < 1000


def test_autocast_lowers_what_is_computed_and_nothing_else():
    layer, rows = torch.nn.Linear(8, 8), torch.ones(4, 8)
    with precision.autocast("cpu", torch.bfloat16):
        assert layer(rows).dtype == torch.bfloat16
    with precision.autocast("cpu", torch.float32):
        assert layer(rows).dtype == torch.float32
    assert layer.weight.dtype == torch.float32
