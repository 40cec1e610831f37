"""Eight weights of a Gaussian patch at a time.

Numba's own vectoriser does not see through the short rows of a patch, so the two innermost steps of the products are
written in LLVM's vector types.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, TypeAlias, cast

import numpy as np
import numpy.typing as npt
from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import types
from numba.extending import intrinsic

from controller.core.arrays import FloatImage
from controller.optics.transport.simd.vectors import FLOAT, broadcast, load, multiply_add, number, pointer, vector_of

LANES: Final = 8
_FLOATS = vector_of(FLOAT, LANES)
_WEIGHTS = vector_of(ir.IntType(16), LANES)
_FUSED: Final = ["contract"]

_Plane: TypeAlias = FloatImage
_Weights: TypeAlias = npt.NDArray[np.uint16]


def _spread_lanes(
    _: Any, red: Any, green: Any, blue: Any, at: Any, weights: Any, k: Any, r: Any, g: Any, b: Any
) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kinds = signature.args
        w = builder.uitofp(load(builder, pointer(context, builder, kinds[4], args[4]), args[5], _WEIGHTS), _FLOATS)
        for i in range(3):
            plane = pointer(context, builder, kinds[i], args[i])
            multiply_add(builder, plane, args[3], w, broadcast(builder, args[6 + i], _FLOATS), _FUSED)
        return context.get_dummy_value()

    light = (types.float32,) * 3
    return types.void(red, green, blue, types.int64, weights, types.int64, *light), generate


def _collect_lanes(_: Any, red: Any, green: Any, blue: Any, at: Any, weights: Any, k: Any, sums: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kinds = signature.args
        w = builder.uitofp(load(builder, pointer(context, builder, kinds[4], args[4]), args[5], _WEIGHTS), _FLOATS)
        totals = pointer(context, builder, kinds[6], args[6])
        for i in range(3):
            plane = load(builder, pointer(context, builder, kinds[i], args[i]), args[3], _FLOATS)
            multiply_add(builder, totals, number(i * LANES), w, plane, _FUSED)
        return context.get_dummy_value()

    return types.void(red, green, blue, types.int64, weights, types.int64, sums), generate


spread_lanes = cast(
    "Callable[[_Plane, _Plane, _Plane, int, _Weights, int, np.float32, np.float32, np.float32], None]",
    intrinsic(_spread_lanes),
)
"""``spread_lanes(red, green, blue, at, weights, k, r, g, b)``: add weights[k:k+8], times r, g and b, to the planes."""

collect_lanes = cast("Callable[[_Plane, _Plane, _Plane, int, _Weights, int, _Plane], None]", intrinsic(_collect_lanes))
"""``collect_lanes(red, green, blue, at, weights, k, sums)``: add weights[k:k+8], times each plane, to the 3 x 8 sums.

The planes are taken from ``at`` on. Both only from compiled code; the arrays are flat, indices unchecked.
"""
