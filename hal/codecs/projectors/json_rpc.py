"""JSON-RPC 2.0 as projectors use it, without I/O: one object follows the other, with nothing between them.

A message is written in a profile as a method, or as a method, a property and a value with spaces between them, e.g.
``property.set optics.shutter.target Closed``. Facts and their sources: docs/reference/projectors.md.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from enum import Enum, auto
from typing import Any, Final

from hal.errors import ProtocolError
from hal.escapes import escaped

OBJECT_END: Final = b"}"
_LARGEST_NUMBER: Final = 1_000_000


class MessageKind(Enum):
    """Meaning of an object. OTHER: a notification, or the answer to another message."""

    RESULT = auto()
    ERROR = auto()
    OTHER = auto()


@dataclass(frozen=True, slots=True)
class Message:
    """An object; ``text``: its result or its error as text."""

    said: MessageKind
    text: str = ""


def json_bytes(template: str, number: int) -> bytes:
    """A request with ``number`` as its id."""
    method, *rest = template.split(" ", 2)
    request: dict[str, Any] = {"jsonrpc": "2.0", "method": method}
    if rest:
        request["params"] = dict(zip(("property", "value"), rest, strict=False))
    request["id"] = number % _LARGEST_NUMBER
    return json.dumps(request).encode("ascii")


def is_complete(data: bytes) -> bool:
    """Whether ``data``, which ends in a brace, is a whole object."""
    return _loaded(data) is not None


def parse_message(data: bytes, sent: bytes) -> Message:
    """Read an object as the answer to ``sent``; ProtocolError("projector-garbage") for anything else."""
    message = _loaded(data)
    if message is None:
        raise ProtocolError(
            "projector-garbage",
            what=f'The projector sent "{escaped(data[:64])}", which is not a JSON object.',
            remedy="Check the address and port, and that the profile in stage.toml is for this model.",
        )
    asked = _loaded(sent) or {}
    if "id" not in asked or str(message.get("id")) != str(asked["id"]):
        return Message(MessageKind.OTHER)
    if "error" in message and message["error"] is not None:
        error = message["error"]
        return Message(MessageKind.ERROR, _line(error.get("message", "") if isinstance(error, dict) else error))
    return Message(MessageKind.RESULT, _line(message.get("result")))


def _loaded(data: bytes) -> dict[str, Any] | None:
    try:
        value = json.loads(data)
    except (ValueError, RecursionError):
        return None
    return value if isinstance(value, dict) else None


def _line(value: object) -> str:
    """A result as one line of printable text; "" for none."""
    text = "" if value is None else value if isinstance(value, str) else json.dumps(value)
    return "".join(character for character in text[:256] if " " <= character <= "~")
