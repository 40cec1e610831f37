"""Sixteen small windows at a time, each of its four by four shares in one vector register.

A cell's buffer is held as strips for that: strip x holds, for each row, the four pixels from x on, so that a window's
sixteen pixels lie side by side (``fill_strips``). Windows of one row of the projector then write to different strips,
which matters to a processor that waits where it reads what it has half written.

Vectors of sixteen floats are one register with AVX-512 and two with AVX2; LLVM takes care of either.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final, cast

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import cgutils, types
from numba.extending import intrinsic

from controller.arrays import FloatImage
from controller.transport.profiles import GROUP, LANES, SKEW_STEPS, SmallProfiles
from controller.transport.windows import STRIP, Windows

_FLOAT, _INDEX, _LANE = ir.FloatType(), ir.IntType(64), ir.IntType(32)
_SIXTEEN, _FOUR = ir.VectorType(_FLOAT, GROUP), ir.VectorType(_FLOAT, LANES)
_NOTHING = ir.Constant(_SIXTEEN, ir.Undefined)
_FLAGS: Final = ["contract", "nsz", "reassoc"]
Index = int | np.signedinteger[Any]


def _field(context: Any, builder: Any, kind: Any, values: Any, name: str) -> Any:
    """The address of an array that is a field of a named tuple."""
    at = kind.fields.index(name)
    return _data(context, builder, kind.types[at], builder.extract_value(values, at))


def _data(context: Any, builder: Any, kind: Any, array: Any) -> Any:
    return context.make_array(kind)(context, builder, value=array).data


def _number(value: int) -> Any:
    return ir.Constant(_INDEX, value)


def _loaded(builder: Any, address: Any, index: Any, vector: Any) -> Any:
    value = builder.load(builder.bitcast(builder.gep(address, [index]), vector.as_pointer()))
    value.align = 4
    return value


def _index(builder: Any, address: Any, index: Any, *, signed: bool = False) -> Any:
    value = builder.load(builder.gep(address, [index]))
    return (builder.sext if signed else builder.zext)(value, _INDEX)


def _mixed(builder: Any, one: Any, other: Any, lanes: Sequence[int]) -> Any:
    return builder.shuffle_vector(one, other, ir.Constant(ir.VectorType(_LANE, len(lanes)), list(lanes)))


class _Addresses:
    """What a step reads, as addresses."""

    def __init__(self, context: Any, builder: Any, kinds: Any, values: Any) -> None:
        for name in ("site", "at", "across", "down", "skew", "gain"):
            setattr(self, name, _field(context, builder, kinds[0], values[0], name))
        self.table = _field(context, builder, kinds[1], values[1], "table")
        skews = _field(context, builder, kinds[1], values[1], "skews")
        self.skews = builder.gep(skews, [_number(SKEW_STEPS * GROUP)])

    site: Any
    at: Any
    across: Any
    down: Any
    skew: Any
    gain: Any


def _shares(builder: Any, a: _Addresses, e: Any, *, skewed: bool) -> tuple[Any, Any]:
    """Where window ``e`` begins in the strips, and its sixteen shares, row by row."""
    at = builder.shl(_index(builder, a.at, e), _number(2))
    along = _loaded(builder, a.table, builder.shl(_index(builder, a.across, e), _number(2)), _FOUR)
    upright = _loaded(builder, a.table, builder.shl(_index(builder, a.down, e), _number(2)), _FOUR)
    none = ir.Constant(_FOUR, ir.Undefined)
    columns = _mixed(builder, along, none, [k % LANES for k in range(GROUP)])
    rows = _mixed(builder, upright, none, [k // LANES for k in range(GROUP)])
    shares = builder.fmul(columns, rows, flags=_FLAGS)
    if skewed:
        skew = builder.shl(_index(builder, a.skew, e, signed=True), _number(4))
        shares = builder.fmul(shares, _loaded(builder, a.skews, skew, _SIXTEEN), flags=_FLAGS)
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
            turned = _mixed(builder, _mixed(builder, one, other, lower), _NOTHING, swapped)
            merged.append(builder.fadd(_mixed(builder, one, other, upper), turned, flags=_FLAGS))
        vectors, apart = merged, apart // 2
    return vectors[0]


def _look_ahead(_: Any, windows: Any, sites: Any, near: Any, far: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kinds = signature.args
        byte = ir.IntType(8).as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [byte, _LANE, _LANE, _LANE])
        name = "llvm.prefetch.p0i8"
        prefetch = cgutils.get_or_insert_function(builder.module, kind, name)  # type: ignore[no-untyped-call]
        how = [ir.Constant(_LANE, value) for value in (0, 3, 1)]
        for name in ("site", "gain", "at", "across", "down"):
            field = builder.gep(_field(context, builder, kinds[0], args[0], name), [args[3]])
            builder.call(prefetch, [builder.bitcast(field, byte), *how])
        site, values = _field(context, builder, kinds[0], args[0], "site"), _data(context, builder, kinds[1], args[1])
        for k in range(0, GROUP, 2):
            at = _index(builder, site, builder.add(args[2], _number(k)))
            builder.call(prefetch, [builder.bitcast(builder.gep(values, [at]), byte), *how])
        return context.get_dummy_value()

    return types.void(windows, sites, types.int64, types.int64), generate


def _see(skewed: bool) -> Any:
    def see(_: Any, windows: Any, table: Any, e: Any, strips: Any, out: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            kinds = signature.args
            a = _Addresses(context, builder, kinds, args)
            light, sites = _data(context, builder, kinds[3], args[3]), _data(context, builder, kinds[4], args[4])
            vectors = []
            for k in range(GROUP):
                at, shares = _shares(builder, a, builder.add(args[2], _number(k)), skewed=skewed)
                vectors.append(builder.fmul(_loaded(builder, light, at, _SIXTEEN), shares, flags=_FLAGS))
            gains = _loaded(builder, a.gain, args[2], _SIXTEEN)
            seen = builder.fmul(_sums(builder, vectors), gains, flags=_FLAGS)
            for k in range(GROUP):
                site = builder.gep(sites, [_index(builder, a.site, builder.add(args[2], _number(k)))])
                own = builder.extract_element(seen, ir.Constant(_LANE, k))
                builder.store(builder.fadd(builder.load(site), own, flags=_FLAGS), site)
            return context.get_dummy_value()

        return types.void(windows, table, types.int64, strips, out), generate

    return intrinsic(see)


def _spread(skewed: bool) -> Any:
    def spread(_: Any, windows: Any, table: Any, e: Any, values: Any, strips: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            kinds = signature.args
            a = _Addresses(context, builder, kinds, args)
            sites, sums = _data(context, builder, kinds[3], args[3]), _data(context, builder, kinds[4], args[4])
            given = _NOTHING
            for k in range(GROUP):
                site = builder.gep(sites, [_index(builder, a.site, builder.add(args[2], _number(k)))])
                given = builder.insert_element(given, builder.load(site), ir.Constant(_LANE, k))
            given = builder.fmul(given, _loaded(builder, a.gain, args[2], _SIXTEEN), flags=_FLAGS)
            for k in range(GROUP):
                at, shares = _shares(builder, a, builder.add(args[2], _number(k)), skewed=skewed)
                _add(builder, sums, at, shares, _mixed(builder, given, _NOTHING, [k] * GROUP))
            return context.get_dummy_value()

        return types.void(windows, table, types.int64, values, strips), generate

    return intrinsic(spread)


def _add(builder: Any, sums: Any, at: Any, shares: Any, value: Any) -> None:
    address = builder.bitcast(builder.gep(sums, [at]), _SIXTEEN.as_pointer())
    before = builder.load(address)
    before.align = 4
    builder.store(builder.fadd(before, builder.fmul(shares, value, flags=_FLAGS), flags=_FLAGS), address).align = 4


def _fill_strips(_: Any, light: Any, at: Any, side: Any, strips: Any, to: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kinds = signature.args
        light, strips = _data(context, builder, kinds[0], args[0]), _data(context, builder, kinds[3], args[3])
        rows, index = [], args[1]
        for _k in range(LANES):
            rows.append(_loaded(builder, light, index, _FOUR))
            index = builder.add(index, args[2])
        upper, lower = (_mixed(builder, rows[k], rows[k + 1], range(2 * LANES)) for k in (0, 2))
        address = builder.bitcast(builder.gep(strips, [args[4]]), _SIXTEEN.as_pointer())
        builder.store(_mixed(builder, upper, lower, range(GROUP)), address).align = 4
        return context.get_dummy_value()

    return types.void(light, types.int64, types.int64, strips, types.int64), generate


def _pour_strips(_: Any, strips: Any, at: Any, sums: Any, to: Any, side: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kinds = signature.args
        strips, sums = _data(context, builder, kinds[0], args[0]), _data(context, builder, kinds[2], args[2])
        nothing = ir.Constant(_SIXTEEN, [0.0] * GROUP)
        over = nothing
        for x in range(0, STRIP, LANES):
            own, beyond = over, nothing
            for k in range(LANES if x < STRIP - LANES else 0):
                four = _loaded(builder, strips, builder.add(args[1], _number(LANES * STRIP * (x + k))), _SIXTEEN)
                # strip k's pixels stand k columns farther right: some among these four columns, the rest in the next
                here = [j - k if j % LANES >= k else GROUP for j in range(GROUP)]
                own = builder.fadd(own, _mixed(builder, four, nothing, here), flags=_FLAGS)
                if k:
                    there = [j + LANES - k if j % LANES < k else GROUP for j in range(GROUP)]
                    beyond = builder.fadd(beyond, _mixed(builder, four, nothing, there), flags=_FLAGS)
            index, over = builder.add(args[3], _number(x)), beyond
            for k in range(LANES):
                row = _mixed(builder, own, _NOTHING, range(LANES * k, LANES * (k + 1)))
                builder.store(row, builder.bitcast(builder.gep(sums, [index]), _FOUR.as_pointer())).align = 4
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
