"""Nikon bodies: standard PTP, with events that must be asked for, formats by COMPRESSION, and exact exposure times."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

from hal.codecs.ptp import makers
from hal.codecs.ptp.datasets import DeviceInfo, PropertyDescription
from hal.codecs.ptp.values import Operation, Property
from hal.deadline import Deadline
from hal.errors import DeviceTimeout
from hal.values import CameraCapabilities, ExposureSettings
from plugins.ptp.body import Channel, PictureStorage, no_live_view, no_such_file
from plugins.ptp.generic import GenericBody
from plugins.ptp.link import LinkEvent, Reply, refused
from plugins.ptp.shot import Shot

_NO_AUTOFOCUS: Final = 0xFFFF_FFFF
_TO_CARD: Final = 0
_POLL_S: Final = 0.02
_VIEW: Final = frozenset({Operation.NIKON_START_VIEW, Operation.NIKON_GET_VIEW, Operation.NIKON_END_VIEW})


class NikonBody(GenericBody):
    """See ``plugins.ptp.body.Body``. Pictures go to the card."""

    def __init__(self, channel: Channel, info: DeviceInfo, storage: PictureStorage) -> None:
        super().__init__(channel, info, storage)
        self._both = storage.both
        self._formats: PropertyDescription | None = None
        self._shutter: PropertyDescription | None = None
        self._viewing = False
        self._format_selectable = False  # by InitiateCapture; COMPRESSION selects it

    @property
    def capabilities(self) -> CameraCapabilities:
        return replace(
            super().capabilities,
            raw=self._format(raw=True) is not None,
            jpeg=self._format(raw=False) is not None,
            live_view=all(self._channel.has(operation) for operation in _VIEW),
        )

    def prepare(self, *, deadline: Deadline) -> None:
        if self._channel.has(Operation.NIKON_CHANGE_MODE):
            # Some bodies refuse it and obey all the same.
            self._channel.once(Operation.NIKON_CHANGE_MODE, 1, deadline=deadline)
        known = set(self._info.properties)
        if self._channel.has(Operation.NIKON_VENDOR_PROPERTIES):
            reply = self._channel.once(Operation.NIKON_VENDOR_PROPERTIES, deadline=deadline)
            known.update(makers.parse_nikon_codes(reply.data) if reply.ok else ())
        super().prepare(deadline=deadline)
        if Property.COMPRESSION in known:
            self._formats = self._describe(Property.COMPRESSION, deadline)
        if Property.NIKON_SHUTTER in known:
            self._shutter = self._describe(Property.NIKON_SHUTTER, deadline)

    def configure(self, settings: ExposureSettings, *, deadline: Deadline) -> ExposureSettings:
        wanted = self._format(raw=settings.raw)
        if wanted is None:
            raise no_such_file(settings.raw)
        self._raw_format, self._jpeg = 1, True  # the check of the standard's formats is made here
        confirmed = super().configure(settings, deadline=deadline)
        if self._formats is not None and self._read(self._formats, deadline) != wanted:
            self._set(self._formats, wanted, deadline)
        return confirmed

    def exposure_s(self, *, deadline: Deadline) -> float:
        if self._shutter is None:
            return super().exposure_s(deadline=deadline)
        return makers.nikon_seconds(self._read(self._shutter, deadline)) or 30.0

    def press(self, shot: Shot, wanted: int, deadline: Deadline) -> Reply:
        self.end_live_view(deadline=deadline)
        if not self._channel.has(Operation.NIKON_CAPTURE_TO_CARD):
            return super().press(shot, 0, deadline)
        shot.fire()
        patience_s = self._channel.timing.answer_s + 2 * shot.exposure_s
        return self._channel.once(
            Operation.NIKON_CAPTURE_TO_CARD, _NO_AUTOFOCUS, _TO_CARD, patience_s=patience_s, deadline=deadline
        )

    def events(self, deadline: Deadline) -> list[LinkEvent]:
        found = super().events(deadline)
        if self._channel.has(Operation.NIKON_GET_EVENT):
            reply = self._channel.once(Operation.NIKON_GET_EVENT, deadline=deadline, note_busy=False)
            if reply.ok:
                found += [LinkEvent(code, (parameter,)) for code, parameter in makers.parse_nikon_events(reply.data)]
        return found

    def wait(self, deadline: Deadline) -> None:
        deadline.sleep(_POLL_S)

    def live_view(self, *, deadline: Deadline) -> bytes:
        if not self.capabilities.live_view:
            raise no_live_view()
        if not self._viewing:
            self._channel.request(Operation.NIKON_START_VIEW, doing="start live view", deadline=deadline)
            self._viewing = True
        until = deadline.within(self._channel.timing.busy_s)
        while True:
            reply = self._channel.once(Operation.NIKON_GET_VIEW, deadline=deadline, note_busy=False)
            if reply.ok:
                return makers.parse_nikon_view(reply.data)
            if not reply.busy:
                raise refused(reply, "show live view")
            if until.passed:
                raise DeviceTimeout(
                    "camera-no-view",
                    what="The camera sent no live view picture in time.",
                    remedy="Enable live view in its menu, leave its menus, then try again.",
                )
            until.sleep(_POLL_S)

    def end_live_view(self, *, deadline: Deadline) -> None:
        if self._viewing:
            self._channel.request(Operation.NIKON_END_VIEW, doing="end live view", deadline=deadline)
            self._viewing = False

    def leave(self, *, deadline: Deadline) -> None:
        self.end_live_view(deadline=deadline)
        if self._channel.has(Operation.NIKON_CHANGE_MODE):
            self._channel.once(Operation.NIKON_CHANGE_MODE, 0, deadline=deadline)

    def _format(self, *, raw: bool) -> int | None:
        """The value of COMPRESSION for a kind of file; without that property it makes a JPEG."""
        if self._formats is None:
            return None if raw else 0
        able = self._formats.numbers()
        wanted: tuple[int, ...] = makers.NIKON_JPEGS
        if raw:
            wanted = (
                (*makers.NIKON_RAW_AND_JPEG, makers.NIKON_RAW)
                if self._both
                else (makers.NIKON_RAW, *makers.NIKON_RAW_AND_JPEG)
            )
        return next((value for value in wanted if value in able), None)

    def _times(self) -> Mapping[float, int]:
        numbers = () if self._shutter is None or not self._shutter.writable else self._shutter.numbers()
        return {round(time_s, 6): value for value in numbers if (time_s := makers.nikon_seconds(value)) is not None}

    def _allowed(self, code: Property) -> list[float]:
        if code is Property.EXPOSURE_TIME and self._shutter is not None:
            return sorted(self._times())
        return super()._allowed(code)

    def _confirm(self, code: Property, value: float, deadline: Deadline) -> float:
        if code is not Property.EXPOSURE_TIME or self._shutter is None:
            return super()._confirm(code, value, deadline)
        wanted = self._times()[value]
        if self._read(self._shutter, deadline) != wanted:
            self._set(self._shutter, wanted, deadline)
        return round(makers.nikon_seconds(self._read(self._shutter, deadline)) or value, 6)
