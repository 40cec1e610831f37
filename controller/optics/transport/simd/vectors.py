"""What all kernels of this package are made of: addresses, loads, stores, lanes and shuffles, in LLVM's vector types.

A kernel is an ``intrinsic`` of numba: a function of numba types that returns a signature and a generator of LLVM code.
Arrays are flat and C-contiguous; indices are 64-bit and unchecked. LLVM maps vectors to the registers of the machine.
numba and llvmlite have no types, so LLVM values are ``Any``.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final

from llvmlite import ir  # type: ignore[import-untyped]

FLOAT, BYTE = ir.FloatType(), ir.IntType(8)
LANE_NUMBER, INDEX = ir.IntType(32), ir.IntType(64)
_ALIGNMENT: Final = {"float": 4, "i16": 2, "i8": 1}
"""Of an array's element: vectors are loaded from any of them on."""


def vector_of(element: Any, lanes: int) -> Any:
    """The vector type of so many lanes."""
    return ir.VectorType(element, lanes)


def undefined(vector: Any) -> Any:
    """A vector of that type with any content."""
    return ir.Constant(vector, ir.Undefined)


def splat(vector: Any, value: float) -> Any:
    """A constant in all lanes."""
    return ir.Constant(vector, [value] * vector.count)


def number(value: int) -> Any:
    """A constant index."""
    return ir.Constant(INDEX, value)


def pointer(context: Any, builder: Any, kind: Any, array: Any) -> Any:
    """Address of an array's data; ``kind`` is its numba type."""
    return context.make_array(kind)(context, builder, value=array).data


def field_pointer(context: Any, builder: Any, kind: Any, values: Any, name: str) -> Any:
    """Address of the data of an array that is a field of a named tuple."""
    at = kind.fields.index(name)
    return pointer(context, builder, kind.types[at], builder.extract_value(values, at))


def address(builder: Any, data: Any, index: Any, vector: Any) -> Any:
    """The address of a vector that starts at an element."""
    return builder.bitcast(builder.gep(data, [index]), vector.as_pointer())


def load(builder: Any, data: Any, index: Any, vector: Any) -> Any:
    """A vector of consecutive elements."""
    value = builder.load(address(builder, data, index, vector))
    value.align = _ALIGNMENT[str(vector.element)]
    return value


def store(builder: Any, data: Any, index: Any, value: Any) -> None:
    """Write a vector to consecutive elements."""
    builder.store(value, address(builder, data, index, value.type)).align = _ALIGNMENT[str(value.type.element)]


def multiply_add(builder: Any, data: Any, index: Any, a: Any, b: Any, flags: list[str]) -> None:
    """Add the product of two vectors to consecutive elements.

    The sum is loaded before the product is made: where ``flags`` let LLVM regroup, it goes by the order of code.
    """
    before = load(builder, data, index, a.type)
    store(builder, data, index, builder.fadd(before, builder.fmul(a, b, flags=flags), flags=flags))


def load_index(builder: Any, data: Any, index: Any, *, signed: bool = False) -> Any:
    """An integer of an array as an index."""
    value = builder.load(builder.gep(data, [index]))
    return (builder.sext if signed else builder.zext)(value, INDEX)


def shuffle(builder: Any, vector: Any, lanes: Iterable[int], other: Any = None) -> Any:
    """The lanes of so many numbers; those of ``other`` count on from the first vector's."""
    chosen = list(lanes)
    which = ir.Constant(vector_of(LANE_NUMBER, len(chosen)), chosen)
    return builder.shuffle_vector(vector, undefined(vector.type) if other is None else other, which)


def lane(builder: Any, vector: Any, k: int) -> Any:
    """One lane, as a number."""
    return builder.extract_element(vector, ir.Constant(LANE_NUMBER, k))


def with_lane(builder: Any, vector: Any, k: int, value: Any) -> Any:
    """The vector with another number in one lane."""
    return builder.insert_element(vector, value, ir.Constant(LANE_NUMBER, k))


def broadcast(builder: Any, value: Any, vector: Any) -> Any:
    """A number in all lanes of a vector."""
    return shuffle(builder, with_lane(builder, undefined(vector), 0, value), [0] * vector.count)
