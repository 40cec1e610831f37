"""Reports of USB HID devices: the ColorHug ALS light sensor (273f:1008) and USB relay boards (16c0:05df). No I/O.

The light sensor follows the HID sensor usages. Input report 1: sensor state, event, illuminance in 0.01 lux. Feature
report 1: connection, reporting, power, sensor state, reporting interval in ms. Sources: HID usage table 0x20; Linux'
hid-sensor-hub, which drives this device.

The relay boards call themselves USBRelay1 to USBRelay8. They have one 8-byte feature report without number: five
characters of serial number, two unused bytes, and one bit per relay. Commands have the same length: command, channel,
zeros. In hidapi both begin with report number 0. Sources: Debian's ``usbrelay`` and ``pyhid-usb-relay``, which use the
V-USB relay firmware.
"""

from __future__ import annotations

import enum
import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from hal.errors import ProtocolError
from hal.escapes import escaped

LIGHT_SENSOR_VENDOR: Final = 0x273F
LIGHT_SENSOR_PRODUCT: Final = 0x1008
LIGHT_SENSOR_REPORT: Final = 1
LUX_UNIT: Final = 0.01

_READING: Final = struct.Struct("<BBBI")
_SETTINGS: Final = struct.Struct("<BBBBBI")
READING_LENGTH: Final = _READING.size
SETTINGS_LENGTH: Final = _SETTINGS.size


class SensorState(enum.IntEnum):
    """State that comes with a reading (HID usages 0x0800 and up, counted from 1)."""

    UNKNOWN = 1
    READY = 2
    NOT_AVAILABLE = 3
    NO_DATA = 4
    INITIALIZING = 5
    ACCESS_DENIED = 6
    ERROR = 7


USABLE: Final = (SensorState.UNKNOWN, SensorState.READY)
"""States in which a reading is valid."""


@dataclass(frozen=True, slots=True)
class LightReading:
    """Illuminance in lux, >= 0, and the sensor's state."""

    illuminance_lux: float
    state: SensorState


@dataclass(frozen=True, slots=True)
class SensorSettings:
    """Feature report 1; ``reporting`` 2 is every change, ``power`` 2 is full. All counted from 1, 0 unset."""

    connection: int = 1
    reporting: int = 2
    power: int = 2
    state: int = 0
    interval_ms: int = 100

    def pack(self) -> bytes:
        """The report with its number."""
        return _SETTINGS.pack(
            LIGHT_SENSOR_REPORT, self.connection, self.reporting, self.power, self.state, self.interval_ms
        )


def parse_reading(report: Sequence[int]) -> LightReading:
    """Read input report 1, its number included. Raises ProtocolError for another length, number or state."""
    data = bytes(report)
    if len(data) != READING_LENGTH or data[0] != LIGHT_SENSOR_REPORT:
        raise _sensor_sent(f"a reading of {len(data)} bytes")
    _, state, _, value = _READING.unpack(data)
    if state not in SensorState.__members__.values():
        raise _sensor_sent(f"the unknown state {state}")
    return LightReading(value * LUX_UNIT, SensorState(state))


def parse_settings(report: Sequence[int]) -> SensorSettings:
    """Read feature report 1, its number included. Raises ProtocolError for another length or number."""
    data = bytes(report)
    if len(data) != SETTINGS_LENGTH or data[0] != LIGHT_SENSOR_REPORT:
        raise _sensor_sent(f"settings of {len(data)} bytes")
    return SensorSettings(*_SETTINGS.unpack(data)[1:])


def _sensor_sent(what: str) -> ProtocolError:
    return ProtocolError(
        "light-sensor-protocol",
        what=f"The light sensor sent {what}.",
        remedy="Unplug it and plug it in again. If this happens again, replace it.",
    )


RELAY_VENDOR: Final = 0x16C0
RELAY_PRODUCT: Final = 0x05DF
RELAY_REPORT_LENGTH: Final = 9
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
    match = _NAME.fullmatch(product)
    return int(match[1]) if match else None


def switch_report(channel: int, closed: bool) -> bytes:
    """The 9 bytes that close or open ``channel`` (1-based, at most 8). Raises ProtocolError (ours)."""
    if not 1 <= channel <= MOST_CHANNELS:
        raise ProtocolError(
            "relay-channel",
            what=f"A relay board has no channel {channel}.",
            remedy=f"Use a channel from 1 to {MOST_CHANNELS}.",
            theirs=False,
        )
    return bytes([0, _ON if closed else _OFF, channel]).ljust(RELAY_REPORT_LENGTH, b"\0")


def parse_state(report: Sequence[int], channels: int) -> RelayState:
    """Read feature report 0 as hidapi gives it: report number, serial number, two bytes, state.

    Raises ProtocolError for a wrong length, another report, or a relay that this board does not have.
    """
    data = bytes(report)
    if len(data) != RELAY_REPORT_LENGTH or data[0] != 0:
        raise _relay_sent(f"a state report of {len(data)} bytes")
    bits = data[8]
    if bits >> channels:
        raise _relay_sent(f"the state of relays that it does not have (0x{bits:02x} with {channels} relays)")
    serial = escaped(data[1 : 1 + _SERIAL_LENGTH].split(b"\0", 1)[0])
    return RelayState(serial, tuple(bool(bits >> channel & 1) for channel in range(channels)))


def _relay_sent(what: str) -> ProtocolError:
    return ProtocolError(
        "relay-protocol",
        what=f"The relay board sent {what}.",
        remedy="Unplug it and plug it in again. If this happens again, replace it.",
    )
