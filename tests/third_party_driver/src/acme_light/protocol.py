"""The protocol of Acme's light posts: ``LUX?`` and ``ID?``, answered by one line each. No I/O."""

from __future__ import annotations

import re
from typing import Final

from hal.errors import ProtocolError
from hal.escapes import escaped

PORT: Final = 5900
END: Final = b"\r\n"
LONGEST: Final = 80
_LUX: Final = re.compile(rb"LUX=([0-9]{1,6}(?:\.[0-9]{1,3})?)\r\n")
_ID: Final = re.compile(rb"ID=([ -~]{1,32});([ -~]{1,32})\r\n")


def parse_lux(line: bytes) -> float:
    """Lux in ``LUX=12.3``. Raises ProtocolError."""
    found = _LUX.fullmatch(line)
    if found is None:
        raise _wrong(line)
    return float(found[1])


def parse_identity(line: bytes) -> tuple[str, str]:
    """Model and serial number in ``ID=model;serial``. Raises ProtocolError."""
    found = _ID.fullmatch(line)
    if found is None:
        raise _wrong(line)
    return found[1].decode("ascii"), found[2].decode("ascii")


def _wrong(line: bytes) -> ProtocolError:
    return ProtocolError(
        "acme-light-garbage",
        what=f'The light post sent "{escaped(line)}".',
        remedy="Check its address in stage.toml; if that is right, switch it off and on.",
    )
