"""Reports of the USB relay boards that call themselves USBRelay1 to USBRelay8 (16c0:05df). No I/O.

The boards have one 8-byte feature report without number: five characters of serial number, two unused bytes, and one
bit per relay. Commands have the same length: command, channel, zeros. In hidapi both begin with report number 0.
Sources: Debian's ``usbrelay`` and ``pyhid-usb-relay``, which use the V-USB relay firmware.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from hal.errors import ProtocolError
from hal.escapes import escaped

VENDOR: Final = 0x16C0
PRODUCT: Final = 0x05DF
REPORT_LENGTH: Final = 9
"""Bytes of a report with its leading report number."""
MOST_CHANNELS: Final = 8

_ON, _OFF = 0xFF, 0xFD
_SERIAL_LENGTH: Final = 5
_NAME: Final = re.compile(r"USBRelay([1-8])")


@dataclass(frozen=True, slots=True)
class RelayState:
    """A board's report: its serial number, and for each channel whether the relay is closed."""

    serial: str
    closed: tuple[bool, ...]


def channels_of(product: str) -> int | None:
    """Number of relays of a board by its USB product name, None for other devices.

    Many makers' HID devices share vendor 16c0 and product 05df; only the name is specific.
    """
    found = _NAME.fullmatch(product)
    return int(found[1]) if found else None


def switch_report(channel: int, closed: bool) -> bytes:
    """The 9 bytes that close or open ``channel`` (1-based, at most 8). Raises ProtocolError (ours)."""
    if not 1 <= channel <= MOST_CHANNELS:
        raise ProtocolError(
            "relay-channel",
            what=f"A relay board has no channel {channel}.",
            remedy=f"Use a channel from 1 to {MOST_CHANNELS}.",
            theirs=False,
        )
    return bytes([0, _ON if closed else _OFF, channel]).ljust(REPORT_LENGTH, b"\0")


def parse_state(report: Sequence[int], channels: int) -> RelayState:
    """Read feature report 0 as hidapi gives it: report number, serial number, two bytes, state.

    Raises ProtocolError for a wrong length, another report, or a relay that this board does not have.
    """
    data = bytes(report)
    if len(data) != REPORT_LENGTH or data[0] != 0:
        raise _wrong(f"a state report of {len(data)} bytes")
    bits = data[8]
    if bits >> channels:
        raise _wrong(f"the state of relays that it does not have (0x{bits:02x} with {channels} relays)")
    serial = escaped(data[1 : 1 + _SERIAL_LENGTH].split(b"\0", 1)[0])
    return RelayState(serial, tuple(bool(bits >> channel & 1) for channel in range(channels)))


def _wrong(what: str) -> ProtocolError:
    return ProtocolError(
        "relay-protocol",
        what=f"The relay board sent {what}.",
        remedy="Unplug it and plug it in again. If this happens again, replace it.",
    )
