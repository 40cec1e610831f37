"""An emulated ColorHug ALS (273f:1008): ambient light through the HID sensor usages."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from plugins.emulated.usb.device import Stall, UsbNames
from plugins.emulated.usb.hid import FEATURE, INPUT, EmulatedHidDevice

LUX_AT_WHITE: Final = 400.0
"""Illuminance for one unit of the bench's linear light: projectors of this class at white, at a metre."""
_LUX_UNIT: Final = 0.01
_READY, _CHANGED = 2, 2
"""State of a sensor that works, and the event "data has changed"."""
_FULL_POWER: Final = 2


class EmulatedLightSensor(EmulatedHidDevice):
    """Reports ``lux`` when asked, and by itself whenever it changes while it is at full power."""

    numbered = True
    # Collection "Sensor: Environmental: Light" with feature and input report 1 (HID usage page 0x20).
    hid_descriptor = bytes.fromhex(
        "05200941a10085010a09031500250275089501b1020a16031500250575089501b1020a19031500250575089501b102"
        "0a01021500250675089501b1020a0e0315002700ffffff75209501b102"
        "0a01021500250675089501810 20a02021500250575089501810 20ad1041500 27ffffff7f75209501550e8102c0".replace(" ", "")
    )
    wrongs: Mapping[str, tuple[Any, ...]] = {"lux": (300.0,), "state": (5, 7, 9)}
    """A bright room; "initializing" for ever, "error", and a state that does not exist."""

    def __init__(self, *, lux: float = 0.5, serial: str = "") -> None:
        super().__init__(UsbNames(0x273F, 0x1008, "Hughski Ltd.", "ColorHugALS", serial))
        self._lux = lux
        self.state = _READY
        """The state that it reports with each reading; 5 is "initializing"."""
        self.settings = (0, 0, 0, 0, 0)
        """Connection, reporting, power, state, interval in ms."""

    @property
    def lux(self) -> float:
        return self._lux

    @lux.setter
    def lux(self, lux: float) -> None:
        self._lux = lux
        if self.settings[2] == _FULL_POWER:
            self.input(self._reading())

    def follow(self, stage: str) -> float:
        """See the ambient light of an emulated stage, with its bumps, as it is now; the lux. Raises DeviceError."""
        # Here: the bench's geometry is slow to load, and few who have a bus have a bench.
        from plugins.emulated.optics.bumps import FILE, bumped, read_bumps
        from plugins.emulated.optics.truth import read_truth

        folder = Path(stage)
        set_up = read_truth(folder)
        truth = bumped(set_up, read_bumps(folder / FILE, set_up))
        self.lux = LUX_AT_WHITE * sum(truth.ambient) / len(truth.ambient)
        return self.lux

    def plugged(self) -> None:
        super().plugged()
        self.settings = (0, 0, 0, 0, 0)

    def get_report(self, kind: int, number: int) -> bytes:
        if number != 1 or kind not in (INPUT, FEATURE):
            raise Stall
        return self._reading() if kind == INPUT else struct.pack("<BBBBBI", 1, *self.settings)

    def set_report(self, kind: int, number: int, data: bytes) -> None:
        if kind != FEATURE or number != 1 or len(data) < 9:
            raise Stall
        _, *settings = struct.unpack("<BBBBBI", data[:9])
        connection, reporting, power, state, interval = settings
        self.settings = (connection, reporting, power, state, interval)

    def _reading(self) -> bytes:
        return struct.pack("<BBBI", 1, self.state, _CHANGED, max(0, round(self._lux / _LUX_UNIT)))
