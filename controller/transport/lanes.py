"""Eight weights at a time, in vector registers.

Numba's own vectoriser does not see through the short rows of a patch, so the two innermost steps of the products are
written in LLVM's vector types; LLVM maps these to whatever vector width the machine has.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, TypeAlias, cast

import numpy as np
import numpy.typing as npt
from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import types
from numba.extending import intrinsic

from controller.arrays import FloatImage

LANES: Final = 8

_FLOATS = ir.VectorType(ir.FloatType(), LANES)
_WEIGHTS = ir.VectorType(ir.IntType(16), LANES)
_WHICH = ir.VectorType(ir.IntType(32), LANES)

_Plane: TypeAlias = FloatImage
_Weights: TypeAlias = npt.NDArray[np.uint16]


def _address(context: Any, builder: Any, kind: Any, array: Any, index: Any, vector: Any) -> Any:
    data = context.make_array(kind)(context, builder, value=array).data
    return builder.bitcast(builder.gep(data, [index]), vector.as_pointer())


def _loaded(builder: Any, address: Any, align: int) -> Any:
    value = builder.load(address)
    value.align = align
    return value


def _all_lanes(builder: Any, value: Any) -> Any:
    nothing = ir.Constant(_FLOATS, ir.Undefined)
    lane = builder.insert_element(nothing, value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(lane, nothing, ir.Constant(_WHICH, [0] * LANES))


def _fused_add(builder: Any, address: Any, a: Any, b: Any) -> None:
    total = builder.fadd(_loaded(builder, address, 4), builder.fmul(a, b, flags=["contract"]), flags=["contract"])
    builder.store(total, address).align = 4


def _spread_lanes(
    _: Any, red: Any, green: Any, blue: Any, at: Any, weights: Any, k: Any, r: Any, g: Any, b: Any
) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kinds = signature.args
        w = _loaded(builder, _address(context, builder, kinds[4], args[4], args[5], _WEIGHTS), 2)
        w = builder.uitofp(w, _FLOATS)
        for i in range(3):
            plane = _address(context, builder, kinds[i], args[i], args[3], _FLOATS)
            _fused_add(builder, plane, w, _all_lanes(builder, args[6 + i]))
        return context.get_dummy_value()

    light = (types.float32,) * 3
    return types.void(red, green, blue, types.int64, weights, types.int64, *light), generate


def _collect_lanes(_: Any, red: Any, green: Any, blue: Any, at: Any, weights: Any, k: Any, sums: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kinds = signature.args
        w = _loaded(builder, _address(context, builder, kinds[4], args[4], args[5], _WEIGHTS), 2)
        w = builder.uitofp(w, _FLOATS)
        for i in range(3):
            plane = _loaded(builder, _address(context, builder, kinds[i], args[i], args[3], _FLOATS), 4)
            total = _address(context, builder, kinds[6], args[6], ir.Constant(ir.IntType(64), i * LANES), _FLOATS)
            _fused_add(builder, total, w, plane)
        return context.get_dummy_value()

    return types.void(red, green, blue, types.int64, weights, types.int64, sums), generate


spread_lanes = cast(
    "Callable[[_Plane, _Plane, _Plane, int, _Weights, int, np.float32, np.float32, np.float32], None]",
    intrinsic(_spread_lanes),
)
"""``spread_lanes(red, green, blue, at, weights, k, r, g, b)``: add weights[k:k+8], times r, g and b, to the planes."""

collect_lanes = cast(
    "Callable[[_Plane, _Plane, _Plane, int, _Weights, int, _Plane], None]",
    intrinsic(_collect_lanes),
)
"""``collect_lanes(red, green, blue, at, weights, k, sums)``: add weights[k:k+8], times each plane, to the 3 x 8 sums.

The planes are taken from ``at`` on. Both only from compiled code; the arrays are flat, indices unchecked.
"""
