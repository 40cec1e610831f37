"""Large windows: four rows of eight shares at a time, in vector registers; one call is a whole window.

A window whose rows are not shifted is the product of one row of the table and one column: ``T p`` adds up each column's
light times the shares down first, and multiplies by the shares across once, at the end, so a share costs one
multiplication. Where a shear shifts each row along x, every row has shares of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, cast

import numpy as np
from numba.core import cgutils, types
from numba.extending import intrinsic

from controller.core.arrays import FloatImage
from controller.optics.transport.simd.vectors import (
    FLOAT,
    broadcast,
    lane,
    load,
    multiply_add,
    number,
    pointer,
    shuffle,
    splat,
    vector_of,
)
from controller.optics.transport.windows.profiles import LANES, PHASE_BITS, PHASES, SHEAR_BITS

_EIGHT: Final = 2 * LANES
_FLAGS: Final = ["contract", "nsz", "reassoc"]
Index = int | np.signedinteger[Any]


class _Window:
    """What both products read of a window; ``row`` leads to its rows."""

    def __init__(self, context: Any, builder: Any, kinds: Any, args: Any, *, sheared: bool) -> None:
        self.builder = builder
        self.values, self.table = (pointer(context, builder, kinds[k], args[k]) for k in (0, 3))
        self.at: Any = args[1]
        self.side: Any = args[2]
        self.shares, self.down, self.width, self.height = args[4:8]
        self.along: Any
        self.shear: Any
        self.below: Any
        self.along, self.shear, self.below = args[8:11] if sheared else (None, None, None)

    def columns(self, do: Callable[[Any, Any], None]) -> None:
        """``do(first column, vector type)`` for eight columns at a time, then for four that are left."""
        builder = self.builder
        eights = builder.and_(self.width, number(-_EIGHT))
        with cgutils.for_range_slice(builder, number(0), eights, number(_EIGHT)) as (column, _):
            do(column, vector_of(FLOAT, _EIGHT))
        with builder.if_then(builder.icmp_signed("<", eights, self.width)):
            do(eights, vector_of(FLOAT, LANES))

    def rows(self, column: Any, vector: Any, do: Callable[[Any, Any, Any, int], None]) -> None:
        """``do(place of the values, weight down, shares across or None, number of four)`` for each row."""
        builder = self.builder
        with cgutils.for_range_slice(builder, number(0), self.height, number(LANES)) as (row, _):
            for k in range(LANES):
                own = builder.add(row, number(k))
                place = builder.add(builder.add(self.at, column), builder.mul(own, self.side))
                weight = builder.load(builder.gep(self.table, [builder.add(self.down, own)]))
                shares = None
                if self.shear is not None:
                    away = builder.add(builder.mul(own, number(PHASES)), self.below)
                    x = builder.add(self.along, builder.ashr(builder.mul(self.shear, away), number(SHEAR_BITS)))
                    place = builder.add(place, builder.ashr(x, number(PHASE_BITS)))
                    phase = builder.mul(builder.and_(x, number(PHASES - 1)), self.width)
                    shares = self.across(builder.add(column, phase), vector)
                do(place, broadcast(builder, weight, vector), shares, k)

    def across(self, column: Any, vector: Any) -> Any:
        return load(self.builder, self.table, self.builder.add(self.shares, column), vector)


def _sum_of_lanes(builder: Any, vector: Any) -> Any:
    apart = vector.type.count // 2
    while apart:
        turned = shuffle(builder, vector, [k ^ apart for k in range(vector.type.count)])
        vector, apart = builder.fadd(vector, turned, flags=_FLAGS), apart // 2
    return lane(builder, vector, 0)


def _types(array: Any, table: Any, sheared: bool) -> list[Any]:
    return [array, types.int64, types.int64, table, *[types.int64] * (7 if sheared else 4)]


def _generate_sum(context: Any, builder: Any, signature: Any, args: Any, *, sheared: bool) -> Any:
    window = _Window(context, builder, signature.args, args, sheared=sheared)
    total = cgutils.alloca_once_value(builder, FLOAT(0))  # type: ignore[no-untyped-call]

    def add_columns(column: Any, vector: Any) -> None:
        # two, because each sum waits for the previous one
        parts = [cgutils.alloca_once(builder, vector) for _ in range(2)]  # type: ignore[no-untyped-call]
        for part in parts:
            builder.store(splat(vector, 0.0), part)

        def add_row(place: Any, weight: Any, shares: Any, k: int) -> None:
            own = builder.fmul(load(builder, window.values, place, vector), weight, flags=_FLAGS)
            own = own if shares is None else builder.fmul(own, shares, flags=_FLAGS)
            builder.store(builder.fadd(builder.load(parts[k % 2]), own, flags=_FLAGS), parts[k % 2])

        window.rows(column, vector, add_row)
        both = builder.fadd(builder.load(parts[0]), builder.load(parts[1]), flags=_FLAGS)
        if not sheared:
            both = builder.fmul(both, window.across(column, vector), flags=_FLAGS)
        builder.store(builder.fadd(builder.load(total), _sum_of_lanes(builder, both), flags=_FLAGS), total)

    window.columns(add_columns)
    return builder.load(total)


def _generate_add(context: Any, builder: Any, signature: Any, args: Any, *, sheared: bool) -> Any:
    window = _Window(context, builder, signature.args, args, sheared=sheared)

    def add_columns(column: Any, vector: Any) -> None:
        given = broadcast(builder, args[-1], vector)
        if not sheared:
            given = builder.fmul(given, window.across(column, vector), flags=_FLAGS)

        def add_row(place: Any, weight: Any, shares: Any, _: int) -> None:
            own = given if shares is None else builder.fmul(given, shares, flags=_FLAGS)
            multiply_add(builder, window.values, place, own, weight, _FLAGS)

        window.rows(column, vector, add_row)

    window.columns(add_columns)
    return context.get_dummy_value()


# numba takes the parameters of an intrinsic from its definition, so each kind has one of its own.


def _window_sum(
    _: Any, light: Any, at: Any, side: Any, table: Any, shares: Any, down: Any, width: Any, height: Any
) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _generate_sum(context, builder, signature, args, sheared=False)

    return types.float32(*_types(light, table, sheared=False)), generate


def _sheared_sum(
    _: Any, light: Any, at: Any, side: Any, table: Any, shares: Any, down: Any, width: Any, height: Any,
    along: Any, shear: Any, below: Any,
) -> Any:  # fmt: skip
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _generate_sum(context, builder, signature, args, sheared=True)

    return types.float32(*_types(light, table, sheared=True)), generate


def _window_add(
    _: Any, sums: Any, at: Any, side: Any, table: Any, shares: Any, down: Any, width: Any, height: Any, value: Any
) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _generate_add(context, builder, signature, args, sheared=False)

    return types.void(*_types(sums, table, sheared=False), types.float32), generate


def _sheared_add(
    _: Any, sums: Any, at: Any, side: Any, table: Any, shares: Any, down: Any, width: Any, height: Any,
    along: Any, shear: Any, below: Any, value: Any,
) -> Any:  # fmt: skip
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _generate_add(context, builder, signature, args, sheared=True)

    return types.void(*_types(sums, table, sheared=True), types.float32), generate


_Sum = Callable[[FloatImage, Index, Index, FloatImage, Index, Index, Index, Index], float]
_Add = Callable[[FloatImage, Index, Index, FloatImage, Index, Index, Index, Index, float], None]
_ShearedSum = Callable[[FloatImage, Index, Index, FloatImage, *tuple[Index, ...]], float]
_ShearedAdd = Callable[
    [FloatImage, Index, Index, FloatImage, Index, Index, Index, Index, Index, Index, Index, float], None
]

window_sum = cast("_Sum", intrinsic(_window_sum))
"""``window_sum(light, at, side, table, shares, down, width, height)``: the sum over ``height`` rows, ``side`` apart
from light[at] on, of ``width`` values times table[shares:], times table[down + row]. Both sizes are multiples of 4."""

window_add = cast("_Add", intrinsic(_window_add))
"""``window_add(sums, ..., height, value)``: the transpose; adds ``value`` times the weights to the sums."""

sheared_sum = cast("_ShearedSum", intrinsic(_sheared_sum))
"""``sheared_sum(light, ..., height, along, shear, below)``: as ``window_sum``, but row j is moved along x: it lies at
x = along + shear (PHASES j + below) / 2^SHEAR_BITS, in steps of 1/PHASES pixel, rounded down. Whole pixels of it move
the place of the row's values, the rest chooses the row of shares: table[shares + rest width:]."""

sheared_add = cast("_ShearedAdd", intrinsic(_sheared_add))
"""``sheared_add(sums, ..., below, value)``: the transpose.

In all of these the arrays are flat and indices unchecked.
"""
