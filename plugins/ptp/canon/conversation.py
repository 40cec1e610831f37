"""Communication with a Canon EOS body: its reports and the state that they add up to, its settings, and keeping it
awake.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import Final

from hal.codecs.ptp.eos import (
    BATTERY_PERCENT,
    BULB_CODES,
    MANUAL_EXPOSURE,
    MANUAL_FOCUS,
    EosCode,
    EosProperty,
    EosRecord,
    ImageFormat,
    ObjectAdded,
    OtherRecord,
    PropertyChanged,
    StatusChanged,
    ValuesChanged,
    aperture_of,
    exposure_of,
    iso_of,
    pack_setting,
    parse_image_format,
    parse_records,
)
from hal.codecs.ptp.values import Operation
from hal.deadline import Deadline
from hal.errors import DeviceTimeout
from hal.values import CameraCapabilities
from plugins.ptp.body import Channel


class EosState:
    """The values and allowed values of a body's properties, from its records."""

    def __init__(self) -> None:
        self.fresh: list[ObjectAdded] = []
        self.busy = False
        self.falls_asleep = False
        self._values: dict[int, bytes] = {}
        self._allowed: dict[int, tuple[int, ...]] = {}
        self._formats: tuple[ImageFormat, ...] = ()

    def take(self, records: Iterable[EosRecord]) -> None:
        """Read records; new files are added to ``fresh``, in order."""
        for record in records:
            match record:
                case PropertyChanged(code, data):
                    self._values[code] = data
                case ValuesChanged(EosProperty.IMAGE_FORMAT, _, formats):
                    self._formats = formats
                case ValuesChanged(code, values):
                    self._allowed[code] = values
                case ObjectAdded():
                    self.fresh.append(record)
                case StatusChanged(busy):
                    self.busy = busy
                case OtherRecord(EosCode.SHUTS_DOWN_SOON):
                    self.falls_asleep = True

    @property
    def capabilities(self) -> CameraCapabilities:
        return CameraCapabilities(
            exposures_s=tuple(sorted(self.exposures())),
            isos=tuple(sorted(self.isos())),
            apertures_f=tuple(sorted(self.apertures())),
            raw=self.pick_format(raw=True) is not None,
            jpeg=self.pick_format(raw=False) is not None,
        )

    def knows(self, code: EosProperty) -> bool:
        return code in self._values

    def forget(self, code: EosProperty) -> None:
        """The value is about to change: the next report is the new one."""
        self._values.pop(code, None)

    def assume(self, code: EosProperty, data: bytes) -> None:
        """Assume a value is set, unless the body has reported another one."""
        self._values.setdefault(code, data)

    def is_set(self, code: EosProperty, data: bytes) -> bool:
        return self._values.get(code, b"")[: len(data)] == data

    def number(self, code: EosProperty) -> int:
        """A value as an integer; 0 if it was not reported."""
        return int.from_bytes(self._values.get(code, b"")[:4], "little")

    def allowed(self, code: EosProperty) -> tuple[int, ...]:
        return self._allowed.get(code, ())

    def exposures(self) -> dict[float, int]:
        """Settable exposures in seconds, and their codes; empty unless the dial stands on M."""
        codes = self.allowed(EosProperty.SHUTTER) if self._manual() else ()
        return {seconds: code for code in codes if (seconds := exposure_of(code)) is not None}

    def bulb(self) -> int | None:
        """The shutter code of bulb, if the body accepts it now."""
        codes = self.allowed(EosProperty.SHUTTER) if self._manual() else ()
        return next((code for code in BULB_CODES if code in codes), None)

    def battery_percent(self) -> int | None:
        return BATTERY_PERCENT.get(self.number(EosProperty.BATTERY)) if self.knows(EosProperty.BATTERY) else None

    def warnings(self) -> list[str]:
        """Settings at the body itself that cause problems."""
        focus = self.knows(EosProperty.FOCUS_MODE) and self.number(EosProperty.FOCUS_MODE) != MANUAL_FOCUS
        return ["autofocus-on"] * focus + ["mode-dial"] * (not self._manual())

    def isos(self) -> dict[int, int]:
        return {iso: code for code in self.allowed(EosProperty.ISO) if (iso := iso_of(code)) is not None}

    def apertures(self) -> dict[float, int]:
        codes = self.allowed(EosProperty.APERTURE) if self._manual() else ()
        return {number: code for code in codes if (number := aperture_of(code)) is not None}

    def current_format(self) -> ImageFormat | None:
        data = self._values.get(EosProperty.IMAGE_FORMAT)
        return None if data is None else parse_image_format(data)

    def pick_format(self, *, raw: bool, both: bool = False) -> ImageFormat | None:
        """The best format of a kind: full-size RAW, alone if the body has it; else one full-size fine JPEG.

        ``both``: RAW and JPEG, if the body has that.
        """
        known = self._formats
        if not known and (current := self.current_format()):
            known = (current,)
        able = [format_ for format_ in known if any(part.raw == raw for part in format_)]
        return min(able, default=None, key=lambda format_: (both and raw and len(format_) == 1, _rank(format_, raw)))

    def _manual(self) -> bool:
        return not self.knows(EosProperty.EXPOSURE_MODE) or self.number(EosProperty.EXPOSURE_MODE) == MANUAL_EXPOSURE


def _rank(image_format: ImageFormat, raw: bool) -> tuple[int, int, int]:
    """Smaller is better: whole picture size, then few files, then little compression."""
    part = next(part for part in image_format if part.raw == raw)
    return part.size, len(image_format), -part.compression


_MOST_DRAINS: Final = 200
_EXPOSURE: Final = (EosProperty.APERTURE, EosProperty.SHUTTER, EosProperty.ISO)


class EosTalk:
    """A channel to a body, and the body's reports."""

    def __init__(self, channel: Channel) -> None:
        self.channel = channel
        self.state = EosState()
        self._alive_at_s = time.monotonic()

    def drain(self, deadline: Deadline) -> None:
        """Read records until an answer has none."""
        for _ in range(_MOST_DRAINS):
            reply = self.channel.request(Operation.EOS_GET_EVENT, doing="report its changes", deadline=deadline)
            records = parse_records(reply.data)
            self.state.take(records)
            if self.state.falls_asleep:
                self.state.falls_asleep = False
                self.keep_alive(deadline, at_once=True)
            if not records:
                return

    def keep_alive(self, deadline: Deadline, *, at_once: bool = False) -> None:
        """Keep it awake, unless that was just done."""
        due = at_once or time.monotonic() - self._alive_at_s >= self.channel.timing.keep_alive_s
        if due and self.channel.has(Operation.EOS_KEEP_DEVICE_ON):
            self.channel.once(Operation.EOS_KEEP_DEVICE_ON, deadline=deadline)
            self._alive_at_s = time.monotonic()

    def set(self, code: EosProperty, value: int | ImageFormat, deadline: Deadline, *, again: bool = False) -> int:
        """Set a property and wait until the body reports it (C189); return the reported value.

        ``again``: also if the body has reported this value already. A body that accepts it and reports nothing is asked
        to report everything. If that does not tell, a note says so and the accepted value counts, except for exposure
        settings: DeviceTimeout("camera-not-confirmed"), because photographs would be measured with a wrong value.
        """
        wanted = pack_setting(code, value)[8:]
        if not again and self.state.is_set(code, wanted):
            return self.state.number(code)
        self.state.forget(code)
        self.channel.request(
            Operation.EOS_SET_PROPERTY,
            data=pack_setting(code, value),
            doing=f"set 0x{code:04x}",
            meanwhile=lambda: self.drain(deadline),
            deadline=deadline,
        )
        if again and not self.state.knows(code):
            self.drain(deadline)
            self.state.assume(code, wanted)  # a body that did not change it has nothing to report
        if not self._reported(code, deadline):
            what = f"The camera took a setting (0x{code:04x}) but did not confirm it."
            if code in _EXPOSURE or deadline.passed:
                # The setting is unknown now; a new connection starts with a full report.
                self.channel.link.close()
                raise DeviceTimeout(
                    "camera-not-confirmed",
                    what=what,
                    remedy="Turn its mode dial to M and leave its menus, then try again.",
                )
            self.channel.diary.add("camera-not-confirmed", what)
            self.state.assume(code, wanted)
        return self.state.number(code)

    def _reported(self, code: EosProperty, deadline: Deadline) -> bool:
        """Wait for the report; then have everything reported, and wait again."""
        if self._await_value(code, deadline.within(self.channel.timing.confirm_s)):
            return True
        if deadline.passed:
            return False
        self.channel.request(Operation.EOS_SET_EVENT_MODE, 1, doing="report everything", deadline=deadline)
        return self._await_value(code, deadline.within(self.channel.timing.confirm_s))

    def _await_value(self, code: EosProperty, until: Deadline) -> bool:
        pause_s = 0.001
        while True:
            try:
                self.drain(until)
            except DeviceTimeout:
                if self.channel.link.broken:
                    raise
            if self.state.knows(code) or until.passed:
                return self.state.knows(code)
            until.sleep(pause_s)
            pause_s = min(0.05, 2 * pause_s)
