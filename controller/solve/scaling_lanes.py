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

from controller.arrays import ByteImage, FloatImage

SIDE: Final = 4
"""A projector pixel's window is so many blocks wide and high."""
STEPS: Final = 4095
"""The table from the square root of light to device values has so many steps."""
_FLOAT, _INT, _BYTE = ir.FloatType(), ir.IntType(32), ir.IntType(8)
_FOUR = ir.VectorType(_FLOAT, 4)
_SIXTEEN = ir.VectorType(_FLOAT, 16)

Index = int | np.signedinteger[Any]
Triple = tuple[np.int64, np.int64, np.int64]


def _load(context: Any, builder: Any, kind: Any, array: Any, index: Any, vector: Any) -> Any:
    data = context.make_array(kind)(context, builder, value=array).data
    value = builder.load(builder.bitcast(builder.gep(data, [index]), vector.as_pointer()))
    value.align = 1 if vector.element == _BYTE else 4
    return value


def _store(context: Any, builder: Any, kind: Any, array: Any, index: Any, value: Any) -> None:
    data = context.make_array(kind)(context, builder, value=array).data
    builder.store(value, builder.bitcast(builder.gep(data, [index]), value.type.as_pointer())).align = 4


def _pick(builder: Any, vector: Any, lanes: list[int]) -> Any:
    which = ir.Constant(ir.VectorType(_INT, len(lanes)), lanes)
    return builder.shuffle_vector(vector, ir.Constant(vector.type, ir.Undefined), which)


def _all(builder: Any, value: Any) -> Any:
    """A number in four lanes."""
    return _pick(builder, builder.insert_element(ir.Constant(_FOUR, ir.Undefined), value, _INT(0)), [0] * 4)


def _constant(value: float) -> Any:
    return ir.Constant(_FOUR, [value] * 4)


def _at_least(builder: Any, value: Any, least: float) -> Any:
    return builder.select(builder.fcmp_ordered(">", value, _constant(least)), value, _constant(least))


def _at_most(builder: Any, value: Any, most: float) -> Any:
    return builder.select(builder.fcmp_ordered("<", value, _constant(most)), value, _constant(most))


def _window_steps(_: Any, scale: Any, at: Any, side: Any, shares: Any, i: Any, gain: Any, unmix: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kinds = signature.args
        four, sixteen = ir.IntType(64)(4), ir.IntType(64)(16)
        bytes_ = _load(context, builder, kinds[3], args[3], builder.mul(args[4], sixteen), ir.VectorType(_BYTE, 16))
        weights = builder.uitofp(bytes_, _SIXTEEN)
        index, step, total = builder.mul(args[1], four), builder.mul(args[2], four), None
        for row in range(SIDE):
            light = _load(context, builder, kinds[0], args[0], index, _SIXTEEN)
            share = _pick(builder, weights, [SIDE * row + k for k in range(SIDE) for _ in range(4)])
            part = builder.fmul(light, share, flags=["fast"])
            total = part if total is None else builder.fadd(total, part, flags=["fast"])
            index = builder.add(index, step)
        for half in (8, 4):
            parts = [_pick(builder, total, list(range(k, k + half))) for k in (0, half)]
            total = builder.fadd(*parts, flags=["fast"])
        gains = _load(context, builder, kinds[5], args[5], builder.mul(args[4], ir.IntType(64)(3)), _FOUR)
        light = builder.fmul(total, gains, flags=["fast"])
        found = None
        for k in range(3):
            column = _load(context, builder, kinds[6], args[6], ir.IntType(64)(4 * k), _FOUR)
            part = builder.fmul(column, _pick(builder, light, [k] * 4), flags=["fast"])
            found = part if found is None else builder.fadd(found, part, flags=["fast"])
        return _table_steps(context, builder, signature, found)

    triple = types.UniTuple(types.int32, 3)  # type: ignore[no-untyped-call]
    return triple(scale, types.int64, types.int64, shares, types.int64, gain, unmix), generate


def _table_steps(context: Any, builder: Any, signature: Any, light: Any) -> Any:
    """sqrt(clip(light)) STEPS, to the nearest whole number, of the first three lanes."""
    inside = _at_most(builder, _at_least(builder, light, 0.0), 1.0)
    kind = ir.FunctionType(_FOUR, [_FOUR])
    root = cgutils.get_or_insert_function(builder.module, kind, "llvm.sqrt.v4f32")  # type: ignore[no-untyped-call]
    steps = builder.fadd(builder.fmul(builder.call(root, [inside]), _constant(float(STEPS))), _constant(0.5))
    whole = builder.fptosi(steps, ir.VectorType(_INT, 4))
    parts = [builder.extract_element(whole, _INT(k)) for k in range(3)]
    return context.make_tuple(builder, signature.return_type, parts)


def _above_black(context: Any, builder: Any, signature: Any, args: Any, light: Any) -> None:
    """Write max(light gain - offset, 0) of a block; ``args`` end with gain, offset, its index, scale, index in it."""
    kinds = signature.args
    at = builder.mul(args[-3], ir.IntType(64)(3))
    gain = _load(context, builder, kinds[-5], args[-5], at, _FOUR)
    offset = _load(context, builder, kinds[-4], args[-4], at, _FOUR)
    found = _at_least(builder, builder.fsub(builder.fmul(light, gain), offset), 0.0)
    into = builder.mul(args[-1], ir.IntType(64)(4))
    _store(context, builder, kinds[-2], args[-2], into, found)


def _scale_of_four(_: Any, picture: Any, a: Any, b: Any, gain: Any, offset: Any, i: Any, scale: Any, k: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        total = None
        for start in args[1:3]:
            left = _load(context, builder, signature.args[0], args[0], start, _FOUR)
            # the second pixel's colours, without reading beyond it
            beside = _load(context, builder, signature.args[0], args[0], builder.add(start, ir.IntType(64)(2)), _FOUR)
            both = builder.fadd(left, _pick(builder, beside, [1, 2, 3, 0]))
            total = both if total is None else builder.fadd(total, both)
        light = builder.fmul(total, _constant(0.25))
        _above_black(context, builder, signature, args, light)
        found = builder.extract_element(light, _INT(0))
        for lane in (1, 2):
            found = builder.fadd(found, builder.extract_element(light, _INT(lane)))
        return found

    index = types.int64
    return types.float32(picture, index, index, gain, offset, index, scale, index), generate


def _scale_of_one(_: Any, r: Any, g: Any, b: Any, gain: Any, offset: Any, i: Any, scale: Any, k: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        light = ir.Constant(_FOUR, [0.0] * 4)
        for lane in range(3):
            light = builder.insert_element(light, args[lane], _INT(lane))
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
