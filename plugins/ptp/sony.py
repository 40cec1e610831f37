"""Sony bodies with protocol 3: one picture at a time in the body's memory, settings that are set and read back.

Older bodies change settings only step by step: use the driver ``gphoto2`` for them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from hal.codecs.ptp import makers
from hal.codecs.ptp.datasets import ObjectInfo, PropertyDescription, pack_value
from hal.codecs.ptp.makers import SonyProperty
from hal.codecs.ptp.values import Operation, broken
from hal.deadline import Deadline, in_seconds
from hal.errors import DeviceRefused, DeviceTimeout
from hal.values import CameraCapabilities, CameraStatus, ExposureSettings
from plugins.camera_files import PendingFile, kind_of
from plugins.ptp.body import Channel, Download, nearest, no_live_view, no_such_file, still_waiting
from plugins.ptp.link import Reply, camera_busy, refused
from plugins.ptp.shot import Picture, Shot

_POLL_S: Final = 0.02
_LET_GO_S: Final = 2.0
_MOST_LEFTOVERS: Final = 20
_U16: Final = 4
_APERTURE_STEP: Final = 0.01


class SonyBody:
    """See ``plugins.ptp.body.Body``."""

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self._known: Mapping[int, PropertyDescription] = {}

    @property
    def capabilities(self) -> CameraCapabilities:
        return CameraCapabilities(
            exposures_s=tuple(sorted(self._times())),
            isos=tuple(sorted(self._isos())),
            apertures_f=tuple(sorted(self._apertures())),
            raw=self._format(raw=True) is not None,
            jpeg=self._format(raw=False) is not None,
        )

    def prepare(self, *, deadline: Deadline) -> None:
        for phase in (1, 2):
            self._connect(phase, deadline)
        ready = deadline.within(self._channel.timing.busy_s)
        while True:
            reply = self._channel.once(Operation.SONY_DEVICE_INFO, makers.SONY_PROTOCOL, 1, deadline=deadline)
            if reply.ok and reply.data:
                break
            if ready.passed:
                raise camera_busy("say what it can do")
            ready.sleep(_POLL_S)
        if int.from_bytes(reply.data[:2], "little") < makers.SONY_PROTOCOL:
            raise DeviceRefused(
                "camera-protocol-old",
                what="This Sony camera has an old remote protocol, whose settings change only step by step.",
                remedy='Use driver = "gphoto2" for this camera.',
            )
        self._connect(3, deadline)
        self._let_go(deadline)
        self._refresh(deadline)

    def configure(self, settings: ExposureSettings, *, deadline: Deadline) -> ExposureSettings:
        self._refresh(deadline)
        image_format = self._format(raw=settings.raw)
        if image_format is None:
            raise no_such_file(settings.raw)
        times, isos, apertures = self._times(), self._isos(), self._apertures()
        exposure_s = nearest(times, settings.exposure_s, setting="exposure time in seconds")
        iso = round(nearest(isos, settings.iso, setting="ISO speed")) if isos else settings.iso
        aperture_f = settings.aperture_f
        if aperture_f is not None:
            aperture_f = nearest(apertures, aperture_f, setting="aperture")
            self._set(SonyProperty.F_NUMBER, apertures[aperture_f], deadline)
        self._set(*image_format, deadline)
        self._set(SonyProperty.SHUTTER, times[exposure_s], deadline)
        if isos:
            self._set(SonyProperty.ISO, isos[iso], deadline)
        return ExposureSettings(exposure_s, iso, aperture_f, settings.raw)

    def exposure_s(self, *, deadline: Deadline) -> float:
        self._refresh(deadline)
        return makers.sony_seconds(self._number(SonyProperty.SHUTTER)) or 30.0

    def release(self, shot: Shot, *, deadline: Deadline) -> None:
        give_up = self._channel.patience(deadline)
        pause_s = 0.01
        while True:
            self._forget_old_pictures(deadline)
            reply = self._press(shot, deadline)
            if reply.ok:
                return
            shot.not_fired()
            if not reply.busy:
                raise refused(reply, "take a picture")
            if give_up.passed:
                raise camera_busy("take a picture")
            give_up.sleep(pause_s)
            pause_s = min(0.5, 2 * pause_s)

    def collect(self, shot: Shot, *, deadline: Deadline) -> list[Picture]:
        """Poll until the picture is in the body's memory; fetching it earlier stops some bodies."""
        while not self._waiting(deadline):
            if shot.overdue(self._channel.timing):
                raise shot.missing()
            still_waiting(deadline)
            self._channel.link.wait_event(_POLL_S, deadline=deadline)
        picture = self._picture(deadline)
        if picture is None:
            raise broken("an object that is not a picture")
        return [picture]

    def download(self, picture: Picture, file: PendingFile, *, deadline: Deadline) -> None:
        self._channel.download(picture, file, partly=None, block=0, deadline=deadline)

    def done(self, picture: Picture, *, deadline: Deadline) -> None:
        """The body forgets a picture that was fetched."""

    def keep_alive(self, *, deadline: Deadline) -> None:
        self._refresh(deadline)

    def status(self, *, deadline: Deadline) -> CameraStatus:
        self._refresh(deadline)
        battery = self._number(SonyProperty.BATTERY) if SonyProperty.BATTERY in self._known else None
        return self._channel.status(battery if battery is not None and 0 <= battery <= 100 else None, [], deadline)

    def live_view(self, *, deadline: Deadline) -> bytes:
        raise no_live_view()

    def end_live_view(self, *, deadline: Deadline) -> None:
        """There is none."""

    def leave(self, *, deadline: Deadline) -> None:
        self._let_go(deadline)

    def _connect(self, phase: int, deadline: Deadline) -> None:
        self._channel.request(Operation.SONY_CONNECT, phase, 0, 0, doing="accept remote control", deadline=deadline)

    def _refresh(self, deadline: Deadline) -> None:
        reply = self._channel.request(Operation.SONY_GET_ALL_PROPERTIES, doing="report its settings", deadline=deadline)
        self._known = makers.parse_sony_properties(reply.data)

    def _waiting(self, deadline: Deadline) -> bool:
        self._channel.link.events()
        self._refresh(deadline)
        return bool(self._number(SonyProperty.OBJECT_IN_MEMORY) & makers.SONY_IN_MEMORY)

    def _picture(self, deadline: Deadline) -> Picture | None:
        reply = self._channel.request(
            Operation.GET_OBJECT_INFO, makers.SONY_MEMORY_HANDLE, doing="describe its picture", deadline=deadline
        )
        info = ObjectInfo.parse(reply.data)
        if kind_of(info.format, info.filename) is None:
            return None
        return Picture(makers.SONY_MEMORY_HANDLE, info.format, info.size, info.filename, waiting=True)

    def _forget_old_pictures(self, deadline: Deadline) -> None:
        """A picture of an earlier shot would be taken for this one's; only fetching removes it."""
        for _ in range(_MOST_LEFTOVERS):
            if not self._waiting(deadline):
                return
            self._picture(deadline)
            self._channel.request(
                Operation.GET_OBJECT,
                makers.SONY_MEMORY_HANDLE,
                doing="forget an old picture",
                into=Download(len, 1 << 30),
                patience_s=deadline.left_s(),
                deadline=deadline,
            )
        raise camera_busy("forget its old pictures")

    def _press(self, shot: Shot, deadline: Deadline) -> Reply:
        """Press half, then fully, and let go in every case."""
        try:
            half = self._button(SonyProperty.HALF_PRESS, makers.BUTTON_DOWN, deadline)
            if not half.ok:
                return half
            shot.fire()
            return self._button(SonyProperty.FULL_PRESS, makers.BUTTON_DOWN, deadline)
        finally:
            self._let_go(in_seconds(_LET_GO_S))

    def _let_go(self, deadline: Deadline) -> None:
        for button in (SonyProperty.FULL_PRESS, SonyProperty.HALF_PRESS):
            if not self._channel.link.broken:
                self._button(button, makers.BUTTON_UP, deadline)

    def _button(self, button: SonyProperty, position: int, deadline: Deadline) -> Reply:
        data = pack_value(_U16, position)
        return self._channel.once(Operation.SONY_PRESS, button, data=data, deadline=deadline)

    def _set(self, code: SonyProperty, value: int, deadline: Deadline) -> None:
        """Set, unless it has the value already, and wait until the body reports it."""
        if self._number(code) == value:
            return
        data = pack_value(self._known[code].data_type, value)
        doing = f"set 0x{code:04x}"
        self._channel.request(Operation.SONY_SET_PROPERTY, code, data=data, doing=doing, deadline=deadline)
        until = deadline.within(self._channel.timing.confirm_s)
        while self._number(code) != value:
            if until.passed:
                raise DeviceTimeout(
                    "camera-not-confirmed",
                    what=f"The camera took a setting (0x{code:04x}) but did not confirm it.",
                    remedy="Turn its mode dial to M and leave its menus, then try again.",
                )
            until.sleep(_POLL_S)
            self._refresh(deadline)

    def _number(self, code: SonyProperty) -> int:
        known = self._known.get(code)
        return known.current if known is not None and isinstance(known.current, int) else 0

    def _numbers(self, code: SonyProperty) -> tuple[int, ...]:
        known = self._known.get(code)
        return known.numbers() if known is not None else ()

    def _times(self) -> dict[float, int]:
        values = self._numbers(SonyProperty.SHUTTER)
        return {round(time_s, 6): value for value in values if (time_s := makers.sony_seconds(value)) is not None}

    def _isos(self) -> dict[int, int]:
        return {iso: value for value in self._numbers(SonyProperty.ISO) if (iso := makers.sony_iso(value)) is not None}

    def _apertures(self) -> dict[float, int]:
        return {round(value * _APERTURE_STEP, 2): value for value in self._numbers(SonyProperty.F_NUMBER) if value > 0}

    def _format(self, *, raw: bool) -> tuple[SonyProperty, int] | None:
        for code, kinds in makers.SONY_FORMATS.items():
            able = self._numbers(code)
            for value in kinds[raw]:
                if value in able:
                    return code, value
        return None
