"""Sixteen small windows at a time, each of its four by four shares in one vector register.

A cell's buffer is held as strips for that: strip x holds, for each row, the four pixels from x on, so that a window's
sixteen pixels lie side by side (``fill_strips``). Windows of one row of the projector then write to different strips,
which matters to a processor that waits where it reads what it has half written.

Vectors of sixteen floats are one register with AVX-512 and two with AVX2; LLVM takes care of either.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, cast

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import cgutils, types
from numba.extending import intrinsic

from controller.core.arrays import FloatImage
from controller.optics.transport.simd.vectors import (
    BYTE,
    FLOAT,
    LANE_NUMBER,
    field_pointer,
    lane,
    load,
    load_index,
    multiply_add,
    number,
    pointer,
    shuffle,
    splat,
    store,
    undefined,
    vector_of,
    with_lane,
)
from controller.optics.transport.windows.profiles import GROUP, LANES, SKEW_STEPS, STRIP, SmallProfiles, Windows

_SIXTEEN, _FOUR = vector_of(FLOAT, GROUP), vector_of(FLOAT, LANES)
_FLAGS: Final = ["contract", "nsz", "reassoc"]
Index = int | np.signedinteger[Any]


class _Addresses:
    """What a step reads, as addresses."""

    def __init__(self, context: Any, builder: Any, kinds: Any, values: Any) -> None:
        for name in ("site", "at", "across", "down", "skew", "gain"):
            setattr(self, name, field_pointer(context, builder, kinds[0], values[0], name))
        self.table = field_pointer(context, builder, kinds[1], values[1], "table")
        skews = field_pointer(context, builder, kinds[1], values[1], "skews")
        self.skews = builder.gep(skews, [number(SKEW_STEPS * GROUP)])

    site: Any
    at: Any
    across: Any
    down: Any
    skew: Any
    gain: Any


def _shares(builder: Any, a: _Addresses, e: Any, *, skewed: bool) -> tuple[Any, Any]:
    """Where window ``e`` begins in the strips, and its sixteen shares, row by row."""
    at = builder.shl(load_index(builder, a.at, e), number(2))
    along = load(builder, a.table, builder.shl(load_index(builder, a.across, e), number(2)), _FOUR)
    upright = load(builder, a.table, builder.shl(load_index(builder, a.down, e), number(2)), _FOUR)
    columns = shuffle(builder, along, [k % LANES for k in range(GROUP)])
    rows = shuffle(builder, upright, [k // LANES for k in range(GROUP)])
    shares = builder.fmul(columns, rows, flags=_FLAGS)
    if skewed:
        skew = builder.shl(load_index(builder, a.skew, e, signed=True), number(4))
        shares = builder.fmul(shares, load(builder, a.skews, skew, _SIXTEEN), flags=_FLAGS)
    return at, shares


def _sums(builder: Any, vectors: list[Any]) -> Any:
    """The sum of each of sixteen vectors, in the lane of its number."""
    apart = GROUP // 2
    while apart:
        swapped = [k ^ apart for k in range(GROUP)]
        upper = [k + GROUP if k & apart else k for k in range(GROUP)]
        lower = [k if k & apart else k + GROUP for k in range(GROUP)]
        merged = []
        for one, other in zip(vectors[:apart], vectors[apart:], strict=True):
            turned = shuffle(builder, shuffle(builder, one, lower, other), swapped)
            merged.append(builder.fadd(shuffle(builder, one, upper, other), turned, flags=_FLAGS))
        vectors, apart = merged, apart // 2
    return vectors[0]


def _look_ahead(_: Any, windows: Any, sites: Any, near: Any, far: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kinds = signature.args
        byte = BYTE.as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [byte, *[LANE_NUMBER] * 3])
        name = "llvm.prefetch.p0i8"
        prefetch = cgutils.get_or_insert_function(builder.module, kind, name)  # type: ignore[no-untyped-call]
        how = [ir.Constant(LANE_NUMBER, value) for value in (0, 3, 1)]
        for name in ("site", "gain", "at", "across", "down"):
            field = builder.gep(field_pointer(context, builder, kinds[0], args[0], name), [args[3]])
            builder.call(prefetch, [builder.bitcast(field, byte), *how])
        site = field_pointer(context, builder, kinds[0], args[0], "site")
        values = pointer(context, builder, kinds[1], args[1])
        for k in range(0, GROUP, 2):
            at = load_index(builder, site, builder.add(args[2], number(k)))
            builder.call(prefetch, [builder.bitcast(builder.gep(values, [at]), byte), *how])
        return context.get_dummy_value()

    return types.void(windows, sites, types.int64, types.int64), generate


def _see(skewed: bool) -> Any:
    def see(_: Any, windows: Any, table: Any, e: Any, strips: Any, out: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            kinds = signature.args
            a = _Addresses(context, builder, kinds, args)
            light, sites = pointer(context, builder, kinds[3], args[3]), pointer(context, builder, kinds[4], args[4])
            vectors = []
            for k in range(GROUP):
                at, shares = _shares(builder, a, builder.add(args[2], number(k)), skewed=skewed)
                vectors.append(builder.fmul(load(builder, light, at, _SIXTEEN), shares, flags=_FLAGS))
            gains = load(builder, a.gain, args[2], _SIXTEEN)
            seen = builder.fmul(_sums(builder, vectors), gains, flags=_FLAGS)
            for k in range(GROUP):
                site = builder.gep(sites, [load_index(builder, a.site, builder.add(args[2], number(k)))])
                own = lane(builder, seen, k)
                builder.store(builder.fadd(builder.load(site), own, flags=_FLAGS), site)
            return context.get_dummy_value()

        return types.void(windows, table, types.int64, strips, out), generate

    return intrinsic(see)


def _spread(skewed: bool) -> Any:
    def spread(_: Any, windows: Any, table: Any, e: Any, values: Any, strips: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            kinds = signature.args
            a = _Addresses(context, builder, kinds, args)
            sites, sums = pointer(context, builder, kinds[3], args[3]), pointer(context, builder, kinds[4], args[4])
            given = undefined(_SIXTEEN)
            for k in range(GROUP):
                site = builder.gep(sites, [load_index(builder, a.site, builder.add(args[2], number(k)))])
                given = with_lane(builder, given, k, builder.load(site))
            given = builder.fmul(given, load(builder, a.gain, args[2], _SIXTEEN), flags=_FLAGS)
            for k in range(GROUP):
                at, shares = _shares(builder, a, builder.add(args[2], number(k)), skewed=skewed)
                multiply_add(builder, sums, at, shares, shuffle(builder, given, [k] * GROUP), _FLAGS)
            return context.get_dummy_value()

        return types.void(windows, table, types.int64, values, strips), generate

    return intrinsic(spread)


def _fill_strips(_: Any, light: Any, at: Any, side: Any, strips: Any, to: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kinds = signature.args
        light, strips = pointer(context, builder, kinds[0], args[0]), pointer(context, builder, kinds[3], args[3])
        rows, index = [], args[1]
        for _k in range(LANES):
            rows.append(load(builder, light, index, _FOUR))
            index = builder.add(index, args[2])
        upper, lower = (shuffle(builder, rows[k], range(2 * LANES), rows[k + 1]) for k in (0, 2))
        store(builder, strips, args[4], shuffle(builder, upper, range(GROUP), lower))
        return context.get_dummy_value()

    return types.void(light, types.int64, types.int64, strips, types.int64), generate


def _pour_strips(_: Any, strips: Any, at: Any, sums: Any, to: Any, side: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kinds = signature.args
        strips, sums = pointer(context, builder, kinds[0], args[0]), pointer(context, builder, kinds[2], args[2])
        nothing = splat(_SIXTEEN, 0.0)
        over = nothing
        for x in range(0, STRIP, LANES):
            own, beyond = over, nothing
            for k in range(LANES if x < STRIP - LANES else 0):
                four = load(builder, strips, builder.add(args[1], number(LANES * STRIP * (x + k))), _SIXTEEN)
                # strip k's pixels stand k columns farther right: some among these four columns, the rest in the next
                here = [j - k if j % LANES >= k else GROUP for j in range(GROUP)]
                own = builder.fadd(own, shuffle(builder, four, here, nothing), flags=_FLAGS)
                if k:
                    there = [j + LANES - k if j % LANES < k else GROUP for j in range(GROUP)]
                    beyond = builder.fadd(beyond, shuffle(builder, four, there, nothing), flags=_FLAGS)
            index, over = builder.add(args[3], number(x)), beyond
            for k in range(LANES):
                store(builder, sums, index, shuffle(builder, own, range(LANES * k, LANES * (k + 1))))
                index = builder.add(index, args[4])
        return context.get_dummy_value()

    return types.void(strips, types.int64, sums, types.int64, types.int64), generate


_See = Callable[[Windows, SmallProfiles, Index, FloatImage, FloatImage], None]
see_upright, see_skewed = cast("tuple[_See, _See]", (_see(False), _see(True)))
"""``see_upright(windows, table, e, strips, out)``: add what the ``GROUP`` windows from ``e`` on see in ``strips``,
times gain, to the sites ``out``; ``see_skewed`` for windows with a skew."""

spread_upright, spread_skewed = cast("tuple[_See, _See]", (_spread(False), _spread(True)))
"""``spread_upright(windows, table, e, values, strips)``: the transposes; add ``values`` of the sites to ``strips``."""

look_ahead = cast("Callable[[Windows, FloatImage, Index, Index], None]", intrinsic(_look_ahead))
"""``look_ahead(windows, sites, near, far)``: bring what the group from ``near`` on needs of ``sites`` to the caches,
and the parameters from ``far`` on, if there are such: runs are too short for the processor to foresee."""

fill_strips = cast("Callable[[FloatImage, Index, Index, FloatImage, Index], None]", intrinsic(_fill_strips))
"""``fill_strips(light, at, side, strips, to)``: write four rows of four of ``light``, ``side`` a row, side by side."""

pour_strips = cast("Callable[[FloatImage, Index, FloatImage, Index, Index], None]", intrinsic(_pour_strips))
"""``pour_strips(strips, at, sums, to, side)``: write four rows, STRIP wide, of what all strips add up to."""

# In all of these the arrays are flat and indices unchecked.
