"""Four rows of four shares at a time, in vector registers: the innermost step of both products over windows.

Numba's own vectoriser does not see through rows that short; LLVM's vector types do.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import cgutils, types
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


def _small_sum(_: Any, light: Any, at: Any, side: Any, table: Any, across: Any, down: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kinds = signature.args
        weights = _loaded(context, builder, kinds[3], args[3], args[5])
        total, index = None, args[1]
        for k in range(LANES):
            part = builder.fmul(
                _loaded(context, builder, kinds[0], args[0], index), _lane(builder, weights, k), flags=["fast"]
            )
            total = part if total is None else builder.fadd(total, part, flags=["fast"])
            index = builder.add(index, args[2])
        total = builder.fmul(total, _loaded(context, builder, kinds[3], args[3], args[4]), flags=["fast"])
        result = builder.extract_element(total, ir.Constant(_LANE, 0))
        for k in range(1, LANES):
            result = builder.fadd(result, builder.extract_element(total, ir.Constant(_LANE, k)), flags=["fast"])
        return result

    return types.float32(light, types.int64, types.int64, table, types.int64, types.int64), generate


def _small_add(_: Any, sums: Any, at: Any, side: Any, table: Any, across: Any, down: Any, value: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kinds = signature.args
        nothing = ir.Constant(_FLOATS, ir.Undefined)
        value = _lane(builder, builder.insert_element(nothing, args[6], ir.Constant(_LANE, 0)), 0)
        weights = _loaded(context, builder, kinds[3], args[3], args[5])
        along = builder.fmul(_loaded(context, builder, kinds[3], args[3], args[4]), value, flags=["fast"])
        index = args[1]
        for k in range(LANES):
            address = _address(context, builder, kinds[0], args[0], index)
            before = builder.load(address)
            before.align = 4
            part = builder.fmul(along, _lane(builder, weights, k), flags=["fast"])
            builder.store(builder.fadd(before, part, flags=["fast"]), address).align = 4
            index = builder.add(index, args[2])
        return context.get_dummy_value()

    return types.void(sums, types.int64, types.int64, table, types.int64, types.int64, types.float32), generate


def _fetch(_: Any, values: Any, index: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, value=args[0]).data
        byte = ir.IntType(8).as_pointer()
        address = builder.bitcast(builder.gep(data, [args[1]]), byte)
        kind = ir.FunctionType(ir.VoidType(), [byte, _LANE, _LANE, _LANE])
        name = "llvm.prefetch.p0i8"
        prefetch = cgutils.get_or_insert_function(builder.module, kind, name)  # type: ignore[no-untyped-call]
        builder.call(prefetch, [address, *(ir.Constant(_LANE, value) for value in (0, 3, 1))])
        return context.get_dummy_value()

    return types.void(values, types.int64), generate


fetch = cast("Callable[[FloatImage, Index], None]", intrinsic(_fetch))
"""``fetch(values, index)``: bring values[index] to the cache, if there is such a place; costs next to nothing."""

small_sum = cast("Callable[[FloatImage, Index, Index, FloatImage, Index, Index], float]", intrinsic(_small_sum))
"""``small_sum(light, at, side, table, across, down)``: sum of the four by four of ``light`` from ``at`` on, ``side`` a
row, times table[across:] along and table[down:] down."""

small_add = cast("Callable[[FloatImage, Index, Index, FloatImage, Index, Index, float], None]", intrinsic(_small_add))
"""``small_add(sums, at, side, table, across, down, value)``: its transpose."""

window_sum = cast("Callable[[FloatImage, Rows, FloatImage, Rows, Index], float]", intrinsic(_window_sum))
"""``window_sum(light, at, table, shares, down)``: sum of four rows of four, light[at[k]:] times table[shares[k]:] times
table[down + k]."""

window_add = cast("Callable[[FloatImage, Rows, FloatImage, Rows, Index, float], None]", intrinsic(_window_add))
"""``window_add(sums, at, table, shares, down, value)``: the transpose; adds ``value`` times the weights to the sums.

In both the arrays are flat and indices unchecked.
"""
