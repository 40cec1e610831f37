"""Four rows of four shares at a time, in vector registers: the innermost step of both products over windows.

Numba's own vectoriser does not see through rows that short; LLVM's vector types do.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, cast

import numpy as np
from numba.core import types
from numba.extending import intrinsic

from controller.core.arrays import FloatImage
from controller.transport.simd.vectors import FLOAT, broadcast, lane, load, multiply_add, pointer, shuffle, vector_of
from controller.transport.windows.profiles import LANES

_FLOATS = vector_of(FLOAT, LANES)
_FAST: Final = ["fast"]
Index = int | np.signedinteger[Any]
Rows = tuple[Index, Index, Index, Index]


def _window_sum(_: Any, light: Any, at: Any, table: Any, shares: Any, down: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kinds = signature.args
        values, table = (pointer(context, builder, kinds[i], args[i]) for i in (0, 2))
        weights, total = load(builder, table, args[4], _FLOATS), None
        for k in range(LANES):
            q = load(builder, values, builder.extract_value(args[1], k), _FLOATS)
            w = load(builder, table, builder.extract_value(args[3], k), _FLOATS)
            row = shuffle(builder, weights, [k] * LANES)
            part = builder.fmul(builder.fmul(q, w, flags=_FAST), row, flags=_FAST)
            total = part if total is None else builder.fadd(total, part, flags=_FAST)
        result = lane(builder, total, 0)
        for k in range(1, LANES):
            result = builder.fadd(result, lane(builder, total, k), flags=_FAST)
        return result

    four = types.UniTuple(types.int64, LANES)  # type: ignore[no-untyped-call]
    return types.float32(light, four, table, four, types.int64), generate


def _window_add(_: Any, sums: Any, at: Any, table: Any, shares: Any, down: Any, value: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kinds = signature.args
        totals, table = (pointer(context, builder, kinds[i], args[i]) for i in (0, 2))
        weights = load(builder, table, args[4], _FLOATS)
        weights = builder.fmul(weights, broadcast(builder, args[5], _FLOATS), flags=_FAST)
        for k in range(LANES):
            w = load(builder, table, builder.extract_value(args[3], k), _FLOATS)
            row = shuffle(builder, weights, [k] * LANES)
            multiply_add(builder, totals, builder.extract_value(args[1], k), w, row, _FAST)
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
