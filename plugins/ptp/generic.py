"""Standard cameras: InitiateCapture, its events, and the standard exposure properties (ISO 15740)."""

from __future__ import annotations

from typing import Final

from hal.codecs.ptp.datasets import DeviceInfo, Form, PropertyDescription, pack_value, parse_value
from hal.codecs.ptp.values import RAW_FORMATS, Answer, EventCode, Format, Operation, Property, broken
from hal.deadline import Deadline
from hal.values import CameraCapabilities, CameraStatus, ExposureSettings
from plugins.camera_files import PendingFile
from plugins.ptp.body import Channel, PictureStorage, nearest, no_live_view, no_such_file, still_waiting
from plugins.ptp.link import camera_busy, card_full, refused
from plugins.ptp.shot import Picture, Shot

_MANUAL: Final = 1
_BLOCK: Final = 4 << 20
_AUTO_ISO: Final = 0xFFFF
_BULB: Final = 0xFFFF_FFFF
_LISTING_EVERY_S: Final = 0.25
_NO_SUCH_FORMAT: Final = (Answer.INVALID_OBJECT_FORMAT, Answer.PARAMETER_NOT_SUPPORTED, Answer.FORMAT_NOT_SELECTABLE)
_STEPS: Final = {Property.EXPOSURE_TIME: 1e-4, Property.EXPOSURE_INDEX: 1.0, Property.F_NUMBER: 0.01}
"""One count of a property, in seconds, ISO and f-stops (ISO 15740 13.3.5)."""


class GenericBody:
    """See ``plugins.ptp.body.Body``."""

    def __init__(self, channel: Channel, info: DeviceInfo, storage: PictureStorage) -> None:
        self._channel = channel
        self._info = info
        self._keep = storage.keep_on_card
        self._settings: dict[Property, PropertyDescription] = {}
        self._raw_format = next((code for code in info.capture_formats if code in RAW_FORMATS), None)
        self._jpeg = Format.JPEG in info.capture_formats or self._raw_format is None
        self._raw = self._raw_format is not None
        self._format_selectable = True

    @property
    def capabilities(self) -> CameraCapabilities:
        isos = tuple(round(iso) for iso in self._allowed(Property.EXPOSURE_INDEX))
        return CameraCapabilities(
            exposures_s=tuple(self._allowed(Property.EXPOSURE_TIME)),
            isos=isos,
            apertures_f=tuple(self._allowed(Property.F_NUMBER)),
            raw=self._raw_format is not None,
            jpeg=self._jpeg,
        )

    def prepare(self, *, deadline: Deadline) -> None:
        if Property.EXPOSURE_PROGRAM in self._info.properties:
            program = self._describe(Property.EXPOSURE_PROGRAM, deadline)
            if program.writable and program.current != _MANUAL and _MANUAL in program.numbers():
                self._set(program, _MANUAL, deadline)
        for code in _STEPS:
            if code in self._info.properties:
                self._settings[code] = self._describe(code, deadline)

    def configure(self, settings: ExposureSettings, *, deadline: Deadline) -> ExposureSettings:
        if not (self._raw_format is not None if settings.raw else self._jpeg):
            raise no_such_file(settings.raw)
        exposure_s = self._choose(Property.EXPOSURE_TIME, settings.exposure_s, "exposure time in seconds")
        iso: float = settings.iso
        if self._allowed(Property.EXPOSURE_INDEX):
            iso = self._choose(Property.EXPOSURE_INDEX, settings.iso, "ISO speed")
        aperture_f = settings.aperture_f
        if aperture_f is not None:
            aperture_f = self._choose(Property.F_NUMBER, aperture_f, "aperture")
            aperture_f = self._confirm(Property.F_NUMBER, aperture_f, deadline)
        exposure_s = self._confirm(Property.EXPOSURE_TIME, exposure_s, deadline)
        if self._allowed(Property.EXPOSURE_INDEX):
            iso = self._confirm(Property.EXPOSURE_INDEX, iso, deadline)
        self._raw = settings.raw
        return ExposureSettings(exposure_s, round(iso), aperture_f, settings.raw)

    def exposure_s(self, *, deadline: Deadline) -> float:
        if Property.EXPOSURE_TIME not in self._settings:
            return 1.0
        value = self._read(self._settings[Property.EXPOSURE_TIME], deadline)
        return 30.0 if value == _BULB else value * _STEPS[Property.EXPOSURE_TIME]

    def release(self, shot: Shot, *, deadline: Deadline) -> None:
        give_up = self._channel.patience(deadline)
        pause_s = 0.01
        while True:
            # At each attempt: while the camera was busy, an earlier picture may have been finished.
            shot.known = self._channel.handles(deadline)
            self._channel.link.events()
            wanted = (self._raw_format if self._raw else Format.JPEG) if self._format_selectable else 0
            shot.fire()
            patience_s = self._channel.timing.answer_s + 2 * shot.exposure_s
            capture = (Operation.INITIATE_CAPTURE, 0, wanted or 0)
            reply = self._channel.once(*capture, patience_s=patience_s, deadline=deadline)
            if reply.ok:
                return
            shot.not_fired()
            if reply.code in _NO_SUCH_FORMAT and self._format_selectable:
                self._format_selectable = False
                continue
            if not reply.busy:
                raise refused(reply, "take a picture")
            if give_up.passed:
                raise camera_busy("take a picture")
            give_up.sleep(pause_s)
            pause_s = min(0.5, 2 * pause_s)

    def collect(self, shot: Shot, *, deadline: Deadline) -> list[Picture]:
        """Wait for the events; if they are late, or were lost with a connection, list the card instead."""
        timing = self._channel.timing
        complete = False
        newest_s = 0.0
        listing_due_s = 0.0 if shot.recovering else shot.exposure_s + timing.grace_s
        while True:
            before = len(shot.found)
            complete = self._follow_events(shot, deadline) or complete
            if not shot.found and (complete or shot.age_s() >= listing_due_s):
                self._look_at(shot, self._channel.handles(deadline), deadline)
                if shot.found and not shot.recovering:
                    self._channel.diary.add("camera-event-lost", "The camera has a picture that it did not report.")
                listing_due_s = shot.age_s() + _LISTING_EVERY_S
            if len(shot.found) > before:
                newest_s = shot.age_s()
            quiet = shot.age_s() - newest_s > timing.grace_s
            if shot.found and (complete or quiet or self._format_selectable):
                return list(shot.found.values())
            if shot.overdue(timing):
                raise shot.missing()
            still_waiting(deadline)
            self._channel.link.wait_event(_LISTING_EVERY_S, deadline=deadline)

    def _follow_events(self, shot: Shot, deadline: Deadline) -> bool:
        """Read the camera's events; True once the capture is complete."""
        complete = False
        for event in self._channel.link.events():
            if event.code == EventCode.OBJECT_ADDED and event.parameters:
                self._look_at(shot, {event.parameters[0]}, deadline)
            elif event.code == EventCode.STORE_FULL and not shot.found:
                raise card_full(Answer.STORE_FULL)
            complete = complete or event.code == EventCode.CAPTURE_COMPLETE
        return complete

    def download(self, picture: Picture, file: PendingFile, *, deadline: Deadline) -> None:
        partly = Operation.GET_PARTIAL_OBJECT if self._channel.has(Operation.GET_PARTIAL_OBJECT) else None
        self._channel.download(picture, file, partly=partly, block=_BLOCK, deadline=deadline)

    def done(self, picture: Picture, *, deadline: Deadline) -> None:
        if not self._keep and self._channel.has(Operation.DELETE_OBJECT):
            self._channel.once(Operation.DELETE_OBJECT, picture.handle, 0, deadline=deadline)

    def keep_alive(self, *, deadline: Deadline) -> None:
        """Any query keeps a standard camera awake."""
        self._channel.once(Operation.GET_STORAGE_IDS, deadline=deadline)

    def status(self, *, deadline: Deadline) -> CameraStatus:
        return self._channel.status(self._channel.battery_percent(deadline), [], deadline)

    def live_view(self, *, deadline: Deadline) -> bytes:
        raise no_live_view()

    def end_live_view(self, *, deadline: Deadline) -> None:
        """There is none."""

    def leave(self, *, deadline: Deadline) -> None:
        """A standard camera has no remote mode to end."""

    def _look_at(self, shot: Shot, handles: set[int] | frozenset[int], deadline: Deadline) -> None:
        for handle in sorted(handles - shot.known - shot.found.keys()):
            picture = self._channel.picture(handle, deadline)
            if picture is not None:
                shot.found[handle] = picture

    def _allowed(self, code: Property) -> list[float]:
        """The property's possible values, ascending; empty if it can't be set."""
        description = self._settings.get(code)
        if description is None or not description.writable:
            return []
        values = description.numbers()
        if description.form is Form.RANGE:
            values = _third_stops(*(value for value in description.values if isinstance(value, int)))
        counts = [value for value in values if value > 0 and value not in (_BULB, _AUTO_ISO)]
        return [round(value * _STEPS[code], 6) for value in counts]

    def _choose(self, code: Property, wanted: float, setting: str) -> float:
        return nearest(self._allowed(code), wanted, setting=setting)

    def _confirm(self, code: Property, value: float, deadline: Deadline) -> float:
        """Set, unless it has the value already, and read back: the value read counts."""
        description = self._settings[code]
        wanted = round(value / _STEPS[code])
        if self._read(description, deadline) != wanted:
            self._set(description, wanted, deadline)
        return round(self._read(description, deadline) * _STEPS[code], 6)

    def _describe(self, code: int, deadline: Deadline) -> PropertyDescription:
        doing = f"describe its setting 0x{code:04x}"
        reply = self._channel.request(Operation.GET_PROPERTY_DESCRIPTION, code, doing=doing, deadline=deadline)
        description = PropertyDescription.parse(reply.data)
        if description.code != code or not isinstance(description.current, int):
            raise broken(f"a description of setting 0x{description.code:04x} instead of 0x{code:04x}")
        return description

    def _set(self, description: PropertyDescription, value: int, deadline: Deadline) -> None:
        self._channel.request(
            Operation.SET_PROPERTY,
            description.code,
            data=pack_value(description.data_type, value),
            doing=f"set 0x{description.code:04x} to {value}",
            deadline=deadline,
        )

    def _read(self, description: PropertyDescription, deadline: Deadline) -> int:
        doing = f"read its setting 0x{description.code:04x}"
        reply = self._channel.request(Operation.GET_PROPERTY, description.code, doing=doing, deadline=deadline)
        value = parse_value(reply.data, description.data_type)
        if not isinstance(value, int):
            raise broken(f"a setting 0x{description.code:04x} that is not a number")
        return value


def _third_stops(minimum: int, maximum: int, step: int) -> tuple[int, ...]:
    """Values of a range in thirds of a stop, each one that the steps allow, ascending."""
    if not 0 < minimum <= maximum or step <= 0:
        return ()
    steps = (round((minimum * 2 ** (third / 3) - minimum) / step) for third in range(97))
    return tuple(sorted({minimum + step * count for count in steps if minimum + step * count <= maximum} | {minimum}))
