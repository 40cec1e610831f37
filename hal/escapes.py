r"""Bytes as printable ASCII, for tapes and messages: without loss, and safe for a terminal.

Bytes 0x20 to 0x7e stand for themselves except the backslash; ``\r``, ``\n``, ``\t`` and ``\\`` are as in C; every other
byte is ``\xNN``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

_SHORT: Final = {0x0D: "\\r", 0x0A: "\\n", 0x09: "\\t", 0x5C: "\\\\"}


def escaped(data: bytes) -> str:
    """Bytes as printable ASCII, in this notation."""
    return "".join(_SHORT.get(byte) or (chr(byte) if 0x20 <= byte <= 0x7E else f"\\x{byte:02x}") for byte in data)


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
