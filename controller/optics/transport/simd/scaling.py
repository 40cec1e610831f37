"""The innermost steps of base times scale, one picture element at a time with its three colours in vector lanes.

Numba's own vectoriser does not see through loops that short; LLVM's vector types do. Every array is flat and every
index unchecked. Four floats are read where three are meant: arrays end with one to spare.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, cast

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import cgutils, types
from numba.extending import intrinsic

from controller.core.arrays import ByteImage, FloatImage
from controller.optics.transport.simd.vectors import (
    BYTE,
    FLOAT,
    LANE_NUMBER,
    broadcast,
    lane,
    load,
    number,
    pointer,
    shuffle,
    splat,
    store,
    vector_of,
    with_lane,
)

SIDE: Final = 4
"""A projector pixel's window is so many blocks wide and high."""
STEPS: Final = 4095
"""The table from the square root of light to device values has so many steps."""
_FOUR, _SIXTEEN, _BYTES = vector_of(FLOAT, 4), vector_of(FLOAT, 16), vector_of(BYTE, 16)
_FAST: Final = ["fast"]
_TRIPLE: Final = types.UniTuple(types.int32, 3)  # type: ignore[no-untyped-call]

Index = int | np.signedinteger[Any]
Triple = tuple[np.int64, np.int64, np.int64]


def _at_least(builder: Any, value: Any, least: float) -> Any:
    return builder.select(builder.fcmp_ordered(">", value, splat(_FOUR, least)), value, splat(_FOUR, least))


def _at_most(builder: Any, value: Any, most: float) -> Any:
    return builder.select(builder.fcmp_ordered("<", value, splat(_FOUR, most)), value, splat(_FOUR, most))


def _window_steps(_: Any, scale: Any, at: Any, side: Any, shares: Any, i: Any, gain: Any, unmix: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        light = _within(builder, _window_light(context, builder, signature.args, args))
        return _table_steps(context, builder, signature, light)

    return _TRIPLE(scale, types.int64, types.int64, shares, types.int64, gain, unmix), generate


def _own_steps(_: Any, scale: Any, at: Any, side: Any, shares: Any, i: Any, gain: Any, unmix: Any, segment: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        light = _within(builder, _window_light(context, builder, signature.args, args))
        return _table_steps(context, builder, signature, _own_light(builder, light, args[7]))

    return _TRIPLE(scale, types.int64, types.int64, shares, types.int64, gain, unmix, types.float32), generate


def _window_light(context: Any, builder: Any, kinds: Any, args: Any) -> Any:
    """What a projector pixel's channels should show."""
    scale, shares, gain, unmix = (pointer(context, builder, kinds[i], args[i]) for i in (0, 3, 5, 6))
    bytes_ = load(builder, shares, builder.mul(args[4], number(16)), _BYTES)
    weights = builder.uitofp(bytes_, _SIXTEEN)
    index, step, total = builder.mul(args[1], number(4)), builder.mul(args[2], number(4)), None
    for row in range(SIDE):
        light = load(builder, scale, index, _SIXTEEN)
        share = shuffle(builder, weights, [SIDE * row + k for k in range(SIDE) for _ in range(4)])
        part = builder.fmul(light, share, flags=_FAST)
        total = part if total is None else builder.fadd(total, part, flags=_FAST)
        index = builder.add(index, step)
    for half in (8, 4):
        parts = [shuffle(builder, total, list(range(k, k + half))) for k in (0, half)]
        total = builder.fadd(*parts, flags=_FAST)
    gains = load(builder, gain, builder.mul(args[4], number(3)), _FOUR)
    light = builder.fmul(total, gains, flags=_FAST)
    found = None
    for k in range(3):
        column = load(builder, unmix, number(4 * k), _FOUR)
        part = builder.fmul(column, shuffle(builder, light, [k] * 4), flags=_FAST)
        found = part if found is None else builder.fadd(found, part, flags=_FAST)
    return found


def _within(builder: Any, light: Any) -> Any:
    return _at_most(builder, _at_least(builder, light, 0.0), 1.0)


def _own_light(builder: Any, shown: Any, segment: Any) -> Any:
    """What the channels make of ``shown``, in [0, 1], beside a white segment; the last lane is of no account."""
    common = shown
    for order in ([1, 2, 0, 3], [2, 0, 1, 3]):
        other = shuffle(builder, shown, order)
        common = builder.select(builder.fcmp_ordered("<", other, common), other, common)
    share, one = broadcast(builder, segment, _FOUR), splat(_FOUR, 1.0)
    less = builder.fsub(shown, builder.fmul(share, common))
    return _within(builder, builder.fdiv(less, builder.fsub(one, share)))


def _table_steps(context: Any, builder: Any, signature: Any, light: Any) -> Any:
    """sqrt(light) STEPS, to the nearest whole number, of the first three lanes; light in [0, 1]."""
    kind = ir.FunctionType(_FOUR, [_FOUR])
    root = cgutils.get_or_insert_function(builder.module, kind, "llvm.sqrt.v4f32")  # type: ignore[no-untyped-call]
    steps = builder.fadd(builder.fmul(builder.call(root, [light]), splat(_FOUR, float(STEPS))), splat(_FOUR, 0.5))
    whole = builder.fptosi(steps, vector_of(LANE_NUMBER, 4))
    parts = [lane(builder, whole, k) for k in range(3)]
    return context.make_tuple(builder, signature.return_type, parts)


def _above_black(context: Any, builder: Any, signature: Any, args: Any, light: Any) -> None:
    """Write max(light gain - offset, 0) of a block; ``args`` end with gain, offset, its index, scale, index in it."""
    gain, offset, scale = (pointer(context, builder, signature.args[i], args[i]) for i in (-5, -4, -2))
    at = builder.mul(args[-3], number(3))
    scaled = builder.fmul(light, load(builder, gain, at, _FOUR))
    found = _at_least(builder, builder.fsub(scaled, load(builder, offset, at, _FOUR)), 0.0)
    store(builder, scale, builder.mul(args[-1], number(4)), found)


def _scale_of_four(_: Any, picture: Any, a: Any, b: Any, gain: Any, offset: Any, i: Any, scale: Any, k: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        total, pixels = None, pointer(context, builder, signature.args[0], args[0])
        for start in args[1:3]:
            left = load(builder, pixels, start, _FOUR)
            # the second pixel's colours, without reading beyond it
            beside = load(builder, pixels, builder.add(start, number(2)), _FOUR)
            both = builder.fadd(left, shuffle(builder, beside, [1, 2, 3, 0]))
            total = both if total is None else builder.fadd(total, both)
        light = builder.fmul(total, splat(_FOUR, 0.25))
        _above_black(context, builder, signature, args, light)
        found = lane(builder, light, 0)
        for channel in (1, 2):
            found = builder.fadd(found, lane(builder, light, channel))
        return found

    index = types.int64
    return types.float32(picture, index, index, gain, offset, index, scale, index), generate


def _scale_of_one(_: Any, r: Any, g: Any, b: Any, gain: Any, offset: Any, i: Any, scale: Any, k: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        light = splat(_FOUR, 0.0)
        for channel in range(3):
            light = with_lane(builder, light, channel, args[channel])
        _above_black(context, builder, signature, args, light)
        return context.get_dummy_value()

    one, index = types.float32, types.int64
    return types.void(one, one, one, gain, offset, index, scale, index), generate


window_steps = cast(
    "Callable[[FloatImage, Index, Index, ByteImage, Index, FloatImage, FloatImage], Triple]", intrinsic(_window_steps)
)
"""``window_steps(scale, at, side, shares, i, gain, unmix)``: steps of the device table for projector pixel ``i``.

``scale`` has four floats a block, ``side`` blocks a row; the window begins at block ``at``; ``shares`` has sixteen
bytes a pixel, ``gain`` three floats; ``unmix`` has four floats a column of the matrix, the last 0.
"""

own_steps = cast(
    "Callable[[FloatImage, Index, Index, ByteImage, Index, FloatImage, FloatImage, np.float32], Triple]",
    intrinsic(_own_steps),
)
"""``own_steps(scale, at, side, shares, i, gain, unmix, segment)``: the same beside a white segment.

``segment``: its share of white. Apart from ``window_steps`` because it takes a sixth longer.
"""

scale_of_four = cast(
    "Callable[[FloatImage, Index, Index, FloatImage, FloatImage, Index, FloatImage, Index], float]",
    intrinsic(_scale_of_four),
)
"""``scale_of_four(picture, a, b, gain, offset, i, scale, k)``: the scale of a block of two by two, to block ``k``.

``a``, ``b``: where its two rows begin in ``picture``, three floats a pixel; ``i``: place in ``gain``, ``offset``.
Returns a sum of its light, which is finite if all of it is.
"""

scale_of_one = cast(
    "Callable[[float, float, float, FloatImage, FloatImage, Index, FloatImage, Index], None]", intrinsic(_scale_of_one)
)
"""``scale_of_one(r, g, b, gain, offset, i, scale, k)``: the same for one light."""
