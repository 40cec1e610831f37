"""Reports of the ColorHug ALS ambient light sensor (273f:1008), which follows the HID sensor usages. No I/O.

Input report 1: sensor state, event, illuminance in 0.01 lux. Feature report 1: connection, reporting, power, sensor
state, reporting interval in ms. Sources: HID usage table 0x20; Linux' hid-sensor-hub, which drives this device.
"""

from __future__ import annotations

import enum
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from hal.errors import ProtocolError

VENDOR: Final = 0x273F
PRODUCT: Final = 0x1008
REPORT: Final = 1
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
        return _SETTINGS.pack(REPORT, self.connection, self.reporting, self.power, self.state, self.interval_ms)


def parse_reading(report: Sequence[int]) -> LightReading:
    """Read input report 1, its number included. Raises ProtocolError for another length, number or state."""
    data = bytes(report)
    if len(data) != READING_LENGTH or data[0] != REPORT:
        raise _wrong(f"a reading of {len(data)} bytes")
    _, state, _, value = _READING.unpack(data)
    if state not in SensorState.__members__.values():
        raise _wrong(f"the unknown state {state}")
    return LightReading(value * LUX_UNIT, SensorState(state))


def parse_settings(report: Sequence[int]) -> SensorSettings:
    """Read feature report 1, its number included. Raises ProtocolError for another length or number."""
    data = bytes(report)
    if len(data) != SETTINGS_LENGTH or data[0] != REPORT:
        raise _wrong(f"settings of {len(data)} bytes")
    return SensorSettings(*_SETTINGS.unpack(data)[1:])


def _wrong(what: str) -> ProtocolError:
    return ProtocolError(
        "light-sensor-protocol",
        what=f"The light sensor sent {what}.",
        remedy="Unplug it and plug it in again. If this happens again, replace it.",
    )
