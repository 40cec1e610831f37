"""Four rows of four shares at a time, in vector registers: the innermost step of both products over windows.

Numba's own vectoriser does not see through rows that short; LLVM's vector types do.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import types
from numba.extending import intrinsic

from controller.arrays import FloatImage
from controller.transport.profiles import LANES

_FLOATS = ir.VectorType(ir.FloatType(), LANES)
_LANE = ir.IntType(32)
_WHICH = ir.VectorType(_LANE, LANES)
Index = int | np.signedinteger[Any]
Rows = tuple[Index, Index, Index, Index]


def _address(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    data = context.make_array(kind)(context, builder, value=array).data
    return builder.bitcast(builder.gep(data, [index]), _FLOATS.as_pointer())


def _loaded(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    value = builder.load(_address(context, builder, kind, array, index))
    value.align = 4
    return value


def _lane(builder: Any, vector: Any, k: int) -> Any:
    """Lane ``k`` of a vector in all lanes."""
    return builder.shuffle_vector(vector, ir.Constant(_FLOATS, ir.Undefined), ir.Constant(_WHICH, [k] * LANES))


def _window_sum(_: Any, light: Any, at: Any, table: Any, shares: Any, down: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kinds = signature.args
        weights = _loaded(context, builder, kinds[2], args[2], args[4])
        total = None
        for k in range(LANES):
            q = _loaded(context, builder, kinds[0], args[0], builder.extract_value(args[1], k))
            w = _loaded(context, builder, kinds[2], args[2], builder.extract_value(args[3], k))
            part = builder.fmul(builder.fmul(q, w, flags=["fast"]), _lane(builder, weights, k), flags=["fast"])
            total = part if total is None else builder.fadd(total, part, flags=["fast"])
        result = builder.extract_element(total, ir.Constant(_LANE, 0))
        for k in range(1, LANES):
            result = builder.fadd(result, builder.extract_element(total, ir.Constant(_LANE, k)), flags=["fast"])
        return result

    four = types.UniTuple(types.int64, LANES)  # type: ignore[no-untyped-call]
    return types.float32(light, four, table, four, types.int64), generate


def _window_add(_: Any, sums: Any, at: Any, table: Any, shares: Any, down: Any, value: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kinds = signature.args
        weights = _loaded(context, builder, kinds[2], args[2], args[4])
        nothing = ir.Constant(_FLOATS, ir.Undefined)
        first = builder.insert_element(nothing, args[5], ir.Constant(_LANE, 0))
        weights = builder.fmul(weights, _lane(builder, first, 0), flags=["fast"])
        for k in range(LANES):
            address = _address(context, builder, kinds[0], args[0], builder.extract_value(args[1], k))
            w = _loaded(context, builder, kinds[2], args[2], builder.extract_value(args[3], k))
            before = builder.load(address)
            before.align = 4
            part = builder.fmul(w, _lane(builder, weights, k), flags=["fast"])
            builder.store(builder.fadd(before, part, flags=["fast"]), address).align = 4
        return context.get_dummy_value()

    four = types.UniTuple(types.int64, LANES)  # type: ignore[no-untyped-call]
    return types.void(sums, four, table, four, types.int64, types.float32), generate


window_sum = cast("Callable[[FloatImage, Rows, FloatImage, Rows, Index], float]", intrinsic(_window_sum))
"""``window_sum(light, at, table, shares, down)``: sum of four rows of four, light[at[k]:] times table[shares[k]:] times
table[down + k]."""

window_add = cast("Callable[[FloatImage, Rows, FloatImage, Rows, Index, float], None]", intrinsic(_window_add))
"""``window_add(sums, at, table, shares, down, value)``: the transpose; adds ``value`` times the weights to the sums.

In both the arrays are flat and indices unchecked.
"""
