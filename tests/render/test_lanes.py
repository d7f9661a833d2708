"""Sixteen float32 lanes against numpy."""

import numpy as np
import pytest
from numba import njit

from ihbench.render import lanes
from ihbench.render.lanes import (
    above,
    absolute,
    any_of,
    at_least,
    both,
    broadcast,
    exp2,
    f32x16,
    floor,
    larger,
    largest,
    load,
    root,
    select,
    smaller,
    store,
    store_where,
    total,
    zeros,
)  # fmt: skip

f32 = np.float32
NUMBERS = np.random.default_rng(0).normal(size=(2, 21)).astype(f32) * 3


@njit
def operated(a, b, out):
    x, y = load(a, 2), load(b, 5)  # unaligned on purpose
    store(out, 0, x + y)
    store(out, 16, x - y)
    store(out, 32, x * y)
    store(out, 48, x / y)
    store(out, 64, smaller(x, y))
    store(out, 80, larger(x, y))
    store(out, 96, select(both(above(x, y), at_least(x, zeros())), x, y))
    store(out, 112, floor(absolute(x)) + root(absolute(y)))
    store(out, 128, f32(2) * lanes.lanes() + x * f32(3) - broadcast(f32(1)))
    store_where(out, 144, x, above(x, y))
    return total(x), largest(y), any_of(above(x, broadcast(f32(1e9)))), any_of(above(x, y))


@pytest.mark.parametrize("masked", [True, False])
def test_operations_are_numpys(monkeypatch, masked):
    monkeypatch.setattr(lanes, "_MASKED_STORES", masked)
    operated.recompile()
    a, b = NUMBERS
    x, y, out = a[2:18], b[5:21], np.full(160, 7, f32)
    summed, top, none, some = operated(a, b, out)
    where = (x > y) & (x >= 0)
    expected = [
        x + y, x - y, x * y, x / y, np.minimum(x, y), np.maximum(x, y), np.where(where, x, y),
        np.floor(abs(x)) + np.sqrt(abs(y)), 2 * np.arange(16) + 3 * x - 1, np.where(x > y, x, 7),
    ]  # fmt: skip
    assert np.allclose(out.reshape(10, 16), expected, rtol=1e-6, atol=1e-6)
    assert summed == pytest.approx(x.sum(), rel=1e-5)
    assert top == y.max()
    assert not none
    assert some == (x > y).any()


@njit
def powers(x, out):
    for at in range(0, len(x), 16):
        store(out, at, exp2(load(x, at)))


def test_powers_of_two():
    x = np.concatenate(
        [np.linspace(-30, 10, 32000), [0, -0.0, 0.5, -0.5, 1, -1, -24, -99.5, 3, 4, 5, 6, 7, 8, 9, 10]]
    )
    x = x.astype(f32)
    out = np.empty_like(x)
    powers(x, out)
    assert np.abs(out / np.exp2(x.astype(np.float64)) - 1).max() < 3e-7
    whole = x == np.round(x)
    assert (out[whole] == np.exp2(x[whole])).all()


def test_a_power_far_below_is_tiny_and_not_nan():
    x = np.array([-100, -1e30, -np.inf, -200] * 4, f32)
    out = np.empty_like(x)
    powers(x, out)
    assert (out == f32(2.0**-100)).all()


def test_a_vector_prints_its_name():
    assert str(f32x16) == "f32x16"
