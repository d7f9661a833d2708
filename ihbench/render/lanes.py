"""Sixteen float32 lanes as a numba type: arithmetic, comparison and 2^x of `f32x16`, one AVX-512 register.

numba has no vector type, and whether LLVM turns one of its loops into vector instructions depends on details that
nobody sees (`ihbench/render/README.md`). With an explicit type nothing has to be recognised, and sums over a whole
loop stay in registers. LLVM splits the lanes on narrower processors, so the code is right everywhere.

Only for compiled code. Operations combine two vectors, or a vector and a float32; masks come from comparisons.
"""

from __future__ import annotations

import operator
import platform
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from llvmlite import binding, ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, models, overload, register_model

LANES = 16

_FLOAT, _INT = ir.FloatType(), ir.IntType(32)
_FLOATS, _INTS, _BITS = (ir.VectorType(element, LANES) for element in (_FLOAT, _INT, ir.IntType(1)))
_FAST = (
    "contract",
    "nsz",
    "arcp",
)  # no assumption that values are finite, and no reassociation: sums keep their order

_MASKED_STORES = platform.machine().lower() in ("x86_64", "amd64")  # elsewhere LLVM makes 16 branches of one


@cache
def wide() -> bool:
    """Whether this processor has vectors that make the explicit lanes worth it: AVX2, AVX-512 or 64-bit ARM."""
    features = binding.get_host_cpu_features()
    return bool(features.get("avx2") or features.get("avx512f")) or platform.machine().lower() in ("arm64", "aarch64")


# ----------------------------------------------------------------------------------------------------
# The types


class _Vector(types.Type):
    """Sixteen values in registers."""


def _register(name: str, llvm: ir.Type) -> types.Type:
    kind = type(name, (_Vector,), {})

    class Model(models.PrimitiveModel):
        def __init__(self, manager: Any, numba_type: types.Type) -> None:
            super().__init__(manager, numba_type, llvm)

    register_model(kind)(Model)
    return kind(name=name)


f32x16 = _register("f32x16", _FLOATS)
mask16 = _register("mask16", _BITS)


# ----------------------------------------------------------------------------------------------------
# Intrinsics: `emit(builder, *values)` returns the value of an operation


def _intrinsic(arity: int, result: types.Type, emit: Callable[..., Any]) -> Any:
    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return emit(builder, *values)

    if arity == 0:
        return intrinsic(lambda typing: (result(), code))
    if arity == 1:
        return intrinsic(lambda typing, a: (result(a), code))
    if arity == 2:
        return intrinsic(lambda typing, a, b: (result(a, b), code))
    return intrinsic(lambda typing, a, b, c: (result(a, b, c), code))


def _constant(value: float) -> ir.Constant:
    return ir.Constant(_FLOATS, [ir.Constant(_FLOAT, float(np.float32(value)))] * LANES)


def _whole(value: int) -> ir.Constant:
    return ir.Constant(_INTS, [ir.Constant(_INT, value)] * LANES)


def _call(builder: Any, name: str, *values: Any) -> Any:
    """An LLVM function from vectors to a vector."""
    kind = ir.FunctionType(_FLOATS, [v.type for v in values])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{LANES}f32"), values)


def _broadcast(builder: Any, value: Any) -> Any:
    undefined = ir.Constant(_FLOATS, ir.Undefined)
    first = builder.insert_element(undefined, value, ir.Constant(_INT, 0))
    return builder.shuffle_vector(first, undefined, _whole(0))


def _halves(builder: Any, value: Any, combine: Callable[[Any, Any], Any]) -> Any:
    """All lanes combined into one value, as a binary tree: the same order on every processor."""
    size = LANES
    while size > 1:
        size //= 2
        low, high = (
            ir.Constant(ir.VectorType(_INT, size), [ir.Constant(_INT, start + lane) for lane in range(size)])
            for start in (0, size)
        )
        value = combine(builder.shuffle_vector(value, value, low), builder.shuffle_vector(value, value, high))
    return builder.extract_element(value, ir.Constant(_INT, 0))


def _smaller(builder: Any, a: Any, b: Any) -> Any:
    return builder.select(builder.fcmp_ordered("<", a, b), a, b)


def _larger(builder: Any, a: Any, b: Any) -> Any:
    return builder.select(builder.fcmp_ordered(">", a, b), a, b)


# of 2^x on [-1/2, 1/2], highest power first: minimax with 2^0 = 1, relative error 9e-8 before rounding
_POWER = (
    1.326472725272692e-3,
    9.671512785779485e-3,
    5.550733744471001e-2,
    2.402224208311171e-1,
    6.931469775976783e-1,
    1,
)


def _power_of_two(builder: Any, exponent: Any) -> Any:
    """2^x, x cut at -100. Adding 1.5 * 2^23 rounds to a whole number, which then stands in the lowest bits and goes
    straight into the exponent of the result."""
    exponent = _larger(builder, exponent, _constant(-100))
    shifted = builder.fadd(exponent, _constant(12582912))
    rest = builder.fsub(exponent, builder.fsub(shifted, _constant(12582912)))
    value: Any = _constant(_POWER[0])
    for coefficient in _POWER[1:]:
        value = builder.fadd(builder.fmul(value, rest, flags=_FAST), _constant(coefficient), flags=_FAST)
    scale = builder.shl(builder.bitcast(shifted, _INTS), _whole(23))
    return builder.bitcast(builder.add(builder.bitcast(value, _INTS), scale), _FLOATS)


def _any(builder: Any, mask: Any) -> Any:
    bits = ir.IntType(LANES)
    return builder.icmp_unsigned("!=", builder.bitcast(mask, bits), ir.Constant(bits, 0))


def _lane_numbers(builder: Any) -> Any:
    return ir.Constant(_FLOATS, [ir.Constant(_FLOAT, float(lane)) for lane in range(LANES)])


def _load(typing, array, index):
    """array[index : index + 16] of a contiguous float32 array, aligned or not; the bounds are the caller's."""

    def code(context, builder, signature, values):
        return builder.load(_address(context, builder, signature, values), align=4)

    return f32x16(array, index), code


def _store(typing, array, index, value):
    """array[index : index + 16] = value."""

    def code(context, builder, signature, values):
        builder.store(values[2], _address(context, builder, signature, values), align=4)
        return context.get_dummy_value()

    return types.none(array, index, value), code


def _store_where(typing, array, index, value, mask):
    """array[index + k] = value[k] where mask[k]."""

    def code(context, builder, signature, values):
        address = _address(context, builder, signature, values)
        if not _MASKED_STORES:
            old = builder.load(address, align=4)
            builder.store(builder.select(values[3], values[2], old), address, align=4)
            return context.get_dummy_value()
        kind = ir.FunctionType(ir.VoidType(), [_FLOATS, address.type, _INT, _BITS])
        function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.masked.store.v{LANES}f32.p0")
        builder.call(function, [values[2], address, ir.Constant(_INT, 4), values[3]])
        return context.get_dummy_value()

    return types.none(array, index, value, mask), code


def _prefetch(typing, array, index):
    """Begin to load array.flat[index] of a contiguous array into the cache; a loop that gathers waits less."""

    def code(context, builder, signature, values):
        data = context.make_array(signature.args[0])(context, builder, values[0]).data
        address = builder.bitcast(builder.gep(data, [values[1]]), ir.IntType(8).as_pointer())
        kind = ir.FunctionType(ir.VoidType(), [address.type, _INT, _INT, _INT])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(function, [address, ir.Constant(_INT, 0), ir.Constant(_INT, 3), ir.Constant(_INT, 1)])
        return context.get_dummy_value()

    return types.none(array, index), code


def _address(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    array = context.make_array(signature.args[0])(context, builder, values[0])
    return builder.bitcast(builder.gep(array.data, [values[1]]), _FLOATS.as_pointer())


load: Any = intrinsic(_load)
store: Any = intrinsic(_store)
store_where: Any = intrinsic(_store_where)
prefetch: Any = intrinsic(_prefetch)
lanes = _intrinsic(0, f32x16, _lane_numbers)  # 0, 1, … 15
zeros = _intrinsic(0, f32x16, lambda builder: _constant(0))
broadcast = _intrinsic(1, f32x16, _broadcast)  # a float32 in every lane
root = _intrinsic(1, f32x16, lambda builder, a: _call(builder, "sqrt", a))
absolute = _intrinsic(1, f32x16, lambda builder, a: _call(builder, "fabs", a))
floor = _intrinsic(1, f32x16, lambda builder, a: _call(builder, "floor", a))
exp2 = _intrinsic(1, f32x16, _power_of_two)
smaller = _intrinsic(2, f32x16, _smaller)
larger = _intrinsic(2, f32x16, _larger)
at_least = _intrinsic(2, mask16, lambda builder, a, b: builder.fcmp_ordered(">=", a, b))
above = _intrinsic(2, mask16, lambda builder, a, b: builder.fcmp_ordered(">", a, b))
both = _intrinsic(2, mask16, lambda builder, a, b: builder.and_(a, b))
select = _intrinsic(3, f32x16, lambda builder, mask, a, b: builder.select(mask, a, b))
any_of = _intrinsic(1, types.boolean, _any)
total = _intrinsic(1, types.float32, lambda b, a: _halves(b, a, lambda x, y: b.fadd(x, y)))
largest = _intrinsic(1, types.float32, lambda b, a: _halves(b, a, lambda x, y: _larger(b, x, y)))


# ----------------------------------------------------------------------------------------------------
# Operators


def _operator(symbol: Callable[[Any, Any], Any], method: str) -> None:
    combine = _intrinsic(2, f32x16, lambda builder, a, b: getattr(builder, method)(a, b, flags=_FAST))

    @overload(symbol)
    def implementation(x, y):
        if x is f32x16 and y is f32x16:
            return lambda x, y: combine(x, y)
        if x is f32x16 and y == types.float32:
            return lambda x, y: combine(x, broadcast(y))
        if x == types.float32 and y is f32x16:
            return lambda x, y: combine(broadcast(x), y)
        return None


for _symbol, _method in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
):
    _operator(_symbol, _method)
