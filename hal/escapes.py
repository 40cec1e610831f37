r"""Bytes as printable ASCII, for tapes and messages: without loss, and safe for a terminal.

Bytes 0x20 to 0x7e stand for themselves except the backslash; ``\r``, ``\n``, ``\t`` and ``\\`` are as in C; every other
byte is ``\xNN``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Final

from hal.errors import ProtocolError

_ESCAPE: Final = re.compile(rb"\\(?:x([0-9a-f]{2})|([rnt\\]))")
_SHORT: Final = {0x0D: "\\r", 0x0A: "\\n", 0x09: "\\t", 0x5C: "\\\\"}
_LONG: Final = {b"r": b"\r", b"n": b"\n", b"t": b"\t", b"\\": b"\\"}


def escaped(data: bytes) -> str:
    """Bytes as printable ASCII, in this notation."""
    return "".join(_SHORT.get(byte) or (chr(byte) if 0x20 <= byte <= 0x7E else f"\\x{byte:02x}") for byte in data)


def unescaped(text: str) -> bytes:
    """The bytes that ``escaped`` wrote; ProtocolError for any other text."""
    data = text.encode("ascii", "backslashreplace")
    if not text.isascii() or b"\\" in _ESCAPE.sub(b"", data):
        raise ProtocolError(
            "tape-wrong",
            what=f"The bytes {text[:80]!r} of the tape are not escaped correctly.",
            remedy="Record it again. Its format is described in docs/reference/tape-format.md.",
        )
    return _ESCAPE.sub(lambda m: bytes.fromhex(m[1].decode()) if m[1] else _LONG[m[2]], data)


def toml_value(value: object) -> str:
    """A value of a TOML file for messages: in TOML's notation, with text in single quotes."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f"'{value}'"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key} = {toml_value(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(toml_value, value)) + "]"
    return str(value)
