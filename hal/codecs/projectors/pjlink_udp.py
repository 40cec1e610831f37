"""Codec of PJLink class 2 by UDP: the search for projectors, and their notifications. No I/O.

Source: "PJLink Specifications" 2.10 of JBMIA, 3.2 and 3.3: UDP port 4352 on both sides. A controller broadcasts
``%2SRCH``; every projector answers within 10 s, after a delay of its own, with its MAC address. A projector notifies
the controllers registered in its menu when it starts, and when its errors, power or input change.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

from hal.codecs.projectors.pjlink import parse_errors, parse_input, parse_power
from hal.errors import ProtocolError
from hal.escapes import escaped
from hal.values import Power

SEARCH: Final = b"%2SRCH\r"
LONGEST_DATAGRAM: Final = 1024
_LINE: Final = re.compile(rb"%2(ACKN|LKUP|ERST|POWR|INPT)=([ -~]{0,64})", re.IGNORECASE)
_MAC: Final = re.compile(r"[0-9a-f]{2}(?::[0-9a-f]{2}){5}|[0-9a-f]{12}")


@dataclass(frozen=True, slots=True)
class SearchAck:
    """A projector answers a search. ``mac`` as ``00:11:22:aa:bb:cc``."""

    mac: str


@dataclass(frozen=True, slots=True)
class LinkUp:
    """A projector has just started and accepts commands now."""

    mac: str


@dataclass(frozen=True, slots=True)
class TroubleChanged:
    """Its errors are these now; words as in ``hal.codecs.projectors.pjlink.parse_errors``; empty: no error any more."""

    trouble: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class PowerChanged:
    power: Power


@dataclass(frozen=True, slots=True)
class InputChanged:
    """The input is this now, e.g. ``31``."""

    input: str


Notification = SearchAck | LinkUp | TroubleChanged | PowerChanged | InputChanged


def parse_datagram(data: bytes) -> tuple[Notification, ...]:
    """Read a datagram: one line or several, each with its CR.

    Raises ProtocolError for anything else; nothing of a datagram counts then.
    """
    lines = data[: LONGEST_DATAGRAM + 1].rstrip(b"\0").split(b"\r")
    if len(data) > LONGEST_DATAGRAM or len(lines) < 2 or lines.pop() != b"":
        raise _garbage(data)
    return tuple(_parsed(line) for line in lines)


def is_notification(line: bytes) -> bool:
    """Whether a line is a notification: some projectors send them on the TCP connection, too, before an answer."""
    match = _LINE.match(line.lstrip(b"\0"))
    # ERST, POWR and INPT are also queries of class 1 and 2: only these two can never be an answer.
    return match is not None and match[1].upper() in (b"ACKN", b"LKUP")


def _parsed(line: bytes) -> Notification:
    match = _LINE.fullmatch(line)
    if match is None:
        raise _garbage(line)
    name, value = match[1].upper(), match[2].decode("ascii")
    if name == b"ERST":
        return TroubleChanged(parse_errors(value))
    if name == b"POWR":
        return PowerChanged(parse_power(value))
    if name == b"INPT":
        return InputChanged(parse_input(value))
    return SearchAck(_mac(value)) if name == b"ACKN" else LinkUp(_mac(value))


def _mac(text: str) -> str:
    plain = text.lower()
    if not _MAC.fullmatch(plain):
        raise _garbage(text.encode())
    digits = plain.replace(":", "")
    return ":".join(digits[i : i + 2] for i in range(0, 12, 2))


def _garbage(data: bytes) -> ProtocolError:
    return ProtocolError(
        "pjlink-garbage",
        what=f'A datagram "{escaped(data[:80])}" is not from PJLink.',
        remedy="Do nothing: another program on the network uses UDP port 4352.",
    )
