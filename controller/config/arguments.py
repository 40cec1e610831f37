"""Settings of a table that become the arguments of a function, checked against its annotations."""

from __future__ import annotations

import types
from collections.abc import Mapping
from typing import Any, Literal, Union, get_args, get_origin

from pydantic import ConfigDict, TypeAdapter, ValidationError

from controller.config.problems import Place

_NAMES: Mapping[Any, str] = {
    float: "a number",
    int: "a whole number",
    str: "text in quotes",
    bool: "true or false",
}


def checked_arguments(place: Place, values: Mapping[str, Any], wanted: Mapping[str, Any]) -> dict[str, Any]:
    """``values`` of the table at ``place`` as the types in ``wanted`` have them; lists become tuples.

    Raises UsageError("stage-key-type") with the line. Numbers must be finite.
    """
    return {key: _checked(place, key, value, wanted[key]) for key, value in values.items()}


def allowed(kind: Any) -> str:
    """A type in words: ``a list of 3, each a number``."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin is Literal:
        return "one of " + ", ".join(f'"{word}"' for word in inner)
    if origin is tuple:
        return f"a list of {len(inner)}, each {allowed(inner[0])}"
    if origin in (Union, types.UnionType):
        return " or ".join(allowed(part) for part in inner if part is not type(None))
    return _NAMES.get(kind, "left out")


def _checked(place: Place, key: str, value: Any, kind: Any) -> Any:
    try:
        adapter = TypeAdapter(kind, config=ConfigDict(strict=True, allow_inf_nan=False))
        return adapter.validate_python(_tuples(value))
    except ValidationError as error:
        raise place.wrong_type(key, value, "is not allowed", allowed(kind)) from error


def _tuples(value: Any) -> Any:
    return tuple(_tuples(item) for item in value) if isinstance(value, list) else value
