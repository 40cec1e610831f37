"""Checks values against annotations at run time, because drivers of other authors are not type-checked."""

from __future__ import annotations

import dataclasses
import functools
import math
import types
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Union, cast, get_args, get_origin, get_type_hints


def mismatch(value: object, annotation: Any) -> str:
    """The problem with ``value``, e.g. ``"power is a str, not a Power"``; "" if there is none.

    Knows classes, dataclasses (field by field), unions, ``list``, ``tuple``, ``Sequence``, ``Mapping``, ``Callable``
    and ``Any``. An ``int`` is accepted as a ``float``, a ``bool`` as neither; numbers must be finite.
    """
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin in (Union, types.UnionType):
        problems = [mismatch(value, choice) for choice in arguments]
        return "" if "" in problems else problems[0]
    if origin is not None:
        return _generic(value, origin, arguments)
    return "" if annotation is Any else _of_class(value, type(None) if annotation is None else annotation)


def _generic(value: object, origin: type, arguments: tuple[Any, ...]) -> str:
    if not isinstance(value, origin) or (origin is Sequence and isinstance(value, str | bytes)):
        return _not_a(value, origin.__name__.lower())
    if origin is tuple:
        return _tuple(cast("tuple[Any, ...]", value), arguments)
    if isinstance(value, Mapping):
        return _first(mismatch(key, arguments[0]) or mismatch(value[key], arguments[1]) for key in value)
    return _first(mismatch(item, arguments[0]) for item in value) if isinstance(value, Sequence) else ""


def _of_class(value: object, wanted: type) -> str:
    accepted: tuple[type, ...] = (int, float) if wanted is float else (wanted,)
    if not isinstance(value, accepted) or (isinstance(value, bool) and wanted is not bool):
        return _not_a(value, wanted.__name__)
    if isinstance(value, float) and not math.isfinite(value):
        return f"{value} is not a finite number"
    if dataclasses.is_dataclass(wanted):
        for name, hint in field_types(wanted).items():
            if problem := mismatch(getattr(value, name), hint):
                return f"{name}: {problem}"
    return ""


def _tuple(value: tuple[Any, ...], arguments: tuple[Any, ...]) -> str:
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        return _first(mismatch(item, arguments[0]) for item in value)
    if len(value) != len(arguments):
        return f"a tuple of {len(value)}, not of {len(arguments)}"
    return _first(mismatch(item, hint) for item, hint in zip(value, arguments, strict=True))


@functools.cache
def field_types(kind: type) -> dict[str, Any]:
    """The type of each field of a dataclass, by name."""
    hints = get_type_hints(kind)
    return {field.name: hints[field.name] for field in dataclasses.fields(kind)}


def _first(problems: Iterable[str]) -> str:
    return next((problem for problem in problems if problem), "")


def _not_a(value: object, wanted: str) -> str:
    if value is None:
        return f"nothing (None) instead of a {wanted}"
    return f"a {type(value).__name__} instead of a {wanted}"
