"""What the operations answer, as JSON Schema: made from the types of the methods that answer."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from dataclasses import dataclass, field, is_dataclass
from functools import reduce
from operator import or_
from types import NoneType, UnionType
from typing import Any, Final, Literal, Union, get_args, get_origin, get_type_hints

from controller.kiosk.interface import Kiosk
from controller.kiosk.operations.accounts import AccountActions
from controller.kiosk.operations.operation import Answer, Operation
from controller.panel.answers import sent_fields
from controller.panel.uploads import Targets

_HOLDERS: Final[dict[str, type]] = {"kiosk": Kiosk, "accounts": AccountActions, "targets": Targets}
_SIMPLE: Final[dict[Any, dict[str, Any]]] = {
    str: {"type": "string"},
    int: {"type": "integer"},
    float: {"type": "number"},
    bool: {"type": "boolean"},
    NoneType: {"type": "null"},
}

BYTES: Final[dict[str, Any]] = {"type": "string", "format": "binary"}
"""A picture or a file. OpenAPI 3.1 needs no schema for it, but generators of clients do."""


def _general() -> dict[str, Any]:
    text = {"type": "string"}
    return {
        "Done": _object({"done": {"type": "boolean"}}) | {"description": "It was done."},
        "Refusal": _object(dict.fromkeys(("code", "what", "remedy"), text))
        | {"description": "What happened, and what to do; the code is stable."},
        "Text": _object({"text": text}) | {"description": "A text; it may be empty."},
    }


@dataclass(slots=True)
class Schemas:
    """The schemas of answers; ``components`` are those of the objects in them, by name, as ``of`` met them."""

    components: dict[str, Any] = field(default_factory=_general)

    def of(self, operation: Operation) -> dict[str, Any]:
        """The JSON Schema of an operation's answer."""
        if operation.answer is Answer.NOTHING:
            return _reference("Done")
        if operation.answer is Answer.TEXT:
            return _reference("Text")
        if operation.answer is not Answer.VALUE:
            return BYTES
        return self._of(operation.gives or _returned(operation))

    def _of(self, kind: Any) -> dict[str, Any]:
        """The schema of a type. Raises TypeError for one that no answer has."""
        origin, inner = get_origin(kind), get_args(kind)
        if kind in _SIMPLE:
            return dict(_SIMPLE[kind])
        if is_dataclass(kind) and isinstance(kind, type):
            return self._named(kind)
        if origin is Literal:
            return {"type": "string", "enum": list(inner)}
        if origin in (Union, UnionType):
            return {"anyOf": [self._of(one) for one in inner]}
        if origin is dict:
            return {"type": "object", "additionalProperties": self._of(inner[1])}
        return self._array(kind)

    def _array(self, kind: Any) -> dict[str, Any]:
        origin, inner = get_origin(kind), get_args(kind)
        if not (inspect.isclass(origin) and issubclass(origin, Sequence)):
            raise TypeError(f"{kind} has no JSON Schema: add it to controller.panel.answer_schemas")
        if origin is not tuple or Ellipsis in inner:
            return {"type": "array", "items": self._of(inner[0])}
        # A pair of texts: a schema with a place of its own for each is understood by few generators.
        items = self._of(reduce(or_, inner))
        return {"type": "array", "items": items, "minItems": len(inner), "maxItems": len(inner)}

    def _named(self, kind: type) -> dict[str, Any]:
        if kind.__name__ not in self.components:
            self.components[kind.__name__] = {}  # for a type that contains itself
            properties = {name: self._of(hint) for name, hint in sent_fields(kind).items()}
            about = inspect.cleandoc(kind.__doc__ or "").replace("``", "")
            self.components[kind.__name__] = _object(properties) | {"description": about}
        return _reference(kind.__name__)


def _returned(operation: Operation) -> Any:
    method = getattr(_HOLDERS[operation.holder], operation.call or operation.name.replace("-", "_"))
    return get_type_hints(method)["return"]


def _object(properties: dict[str, Any]) -> dict[str, Any]:
    """All of them are always there. A later version may add others."""
    return {"type": "object", "properties": properties, "required": list(properties)}


def _reference(name: str) -> dict[str, Any]:
    return {"$ref": f"#/components/schemas/{name}"}
