"""What every emulated camera body has: identity, memory card, battery, shutter, faults, operations of the standard."""

from __future__ import annotations

import struct
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import count
from typing import Final

from plugins.emulated.cameras.wire import (
    ALREADY_OPEN,
    BUSY,
    GENERAL_ERROR,
    NO_SUCH_HANDLE,
    NO_SUCH_PROPERTY,
    NO_THUMBNAIL,
    NOT_OPEN,
    NOT_SUPPORTED,
    STORE_FULL,
    Gone,
    PtpOutcome,
    text,
    u16s,
    u32s,
)
from plugins.emulated.core.faults import FaultCounts
from plugins.emulated.core.shot import Expose, ShotSettings

STORAGE: Final = 0x0001_0001
FOLDER: Final = 0x3001
_ROOT: Final = 0xFFFF_FFFF


@dataclass(frozen=True, slots=True)
class Stored:
    """A file or folder."""

    handle: int
    parent: int
    format: int
    name: str
    data: bytes
    taken: str

    def info(self) -> bytes:
        """Its ObjectInfo dataset."""
        folder = self.format == FOLDER
        head = struct.pack("<IHHIHIII", STORAGE, self.format, 0, len(self.data), 0, 0, 0, 0)
        middle = struct.pack("<IIIIHII", 0, 0, 0, self.parent, 1 if folder else 0, 0, 0)
        return head + middle + text(self.name) + text(self.taken) + text(self.taken) + text("")


@dataclass(slots=True)
class Card:
    """DCIM/100VELA and what was photographed since; ``waiting`` holds what the computer has not fetched yet."""

    capacity: int = 4 << 30
    objects: dict[int, Stored] = field(default_factory=dict)
    waiting: dict[int, Stored] = field(default_factory=dict)
    _handles: count[int] = field(default_factory=lambda: count(1))
    _folder: int = 0

    def __post_init__(self) -> None:
        dcim = self.add(0, FOLDER, "DCIM", b"", "20070101T000000")
        self._folder = self.add(dcim.handle, FOLDER, "100VELA", b"", "20070101T000000").handle

    @property
    def free(self) -> int:
        return max(0, self.capacity - sum(len(one.data) for one in self.objects.values()))

    def add(self, parent: int, format_code: int, name: str, data: bytes, taken: str) -> Stored:
        stored = Stored(next(self._handles), parent, format_code, name, data, taken)
        self.objects[stored.handle] = stored
        return stored

    def add_picture(self, format_code: int, name: str, data: bytes, taken: str, *, to_host: bool) -> Stored:
        if not to_host:
            return self.add(self._folder, format_code, name, data, taken)
        stored = Stored(0x9000_0000 + next(self._handles), 0, format_code, name, data, taken)
        self.waiting[stored.handle] = stored
        return stored

    def find(self, handle: int) -> Stored | None:
        return self.objects.get(handle) or self.waiting.get(handle)

    def handles(self, format_code: int, parent: int) -> list[int]:
        """Handles as GetObjectHandles filters them: parent 0 means everywhere, 0xFFFFFFFF the top."""
        return [
            one.handle
            for one in self.objects.values()
            if (not format_code or one.format == format_code)
            and (not parent or one.parent == (0 if parent == _ROOT else parent))
        ]

    def storage_info(self) -> bytes:
        images = min(9999, self.free // (16 << 20))
        head = struct.pack("<HHHQQI", 4, 3, 0, self.capacity, self.free, images)
        return head + text("Emulated card") + text("VELATURA")


JPEG: Final = 0x3801
_TICK_S: Final = 0.01


@dataclass(frozen=True, slots=True)
class CameraNames:
    """Who the camera says it is."""

    maker: str = "Velatura"
    model: str = "Emulated camera"
    serial: str = "0123456789"
    firmware: str = "1.0.0"


@dataclass(slots=True)
class CameraFaults(FaultCounts):
    """Knobs, turned at any time. Counts go down as they are used; switches stay until they are turned back.

    ``busy``: that many requests to set or release are answered with busy; ``drop_before_exposure``,
    ``drop_after_exposure``, ``drop_in_transfer``: the connection ends there, that many times; ``lost_events``: that
    many reports of a new picture never come; ``wrong_lengths``: that many data phases announce more than they send;
    ``garbage``: that many answers are noise; ``slow_s``: before every answer; ``card_full``; ``silent``: no answers;
    ``autofocus_fails``: that many presses find no focus; ``target_flips``: that many times the body changes by itself
    from the computer to its card before an exposure, and says nothing; ``unconfirmed``: properties whose changes an EOS
    never reports; ``space_refused``: an EOS refuses to hear of the computer's free space, and exposes all the same;
    ``late_events_s``: how long after the first connection the event port of PTP/IP opens.
    """

    busy: int = 0
    drop_before_exposure: int = 0
    drop_after_exposure: int = 0
    drop_in_transfer: int = 0
    lost_events: int = 0
    wrong_lengths: int = 0
    garbage: int = 0
    slow_s: float = 0.0
    card_full: bool = False
    silent: bool = False
    autofocus_fails: int = 0
    target_flips: int = 0
    unconfirmed: frozenset[int] = frozenset()
    space_refused: bool = False
    late_events_s: float = 0.0


@dataclass(slots=True)
class ExposedPicture:
    """One exposure on its way: what was set, and its files once the shutter has closed."""

    settings: ShotSettings
    to_host: bool
    stored: list[Stored] = field(default_factory=list)


class EmulatedBody:
    """Answers operations; families override ``vendor`` and the hooks. All of it under ``self.lock``.

    Parameters
    ----------
    expose : makes the files of an exposure; called from the shutter's own thread
    names : identity; ``usual_names`` unless given
    time_scale : real seconds for each second of exposure
    raw : False for a camera that makes JPEG files only
    faults : knobs that may be turned while it runs
    """

    usual_names = CameraNames()
    operations: tuple[int, ...] = ()
    with_data: tuple[int, ...] = (0x1016, 0x9110)
    """Operations whose data come from the computer."""
    events: tuple[int, ...] = (0x4002, 0x4003, 0x400A, 0x400D)
    properties: tuple[int, ...] = (0x5001,)
    capture_formats: tuple[int, ...] = (JPEG,)
    vendor_extension = 0
    raw_format = 0x3811
    raw_ending = "DNG"
    _common = (0x1001, 0x1002, 0x1003, 0x1004, 0x1005, 0x1006, 0x1007, 0x1008, 0x1009, 0x100A, 0x100B, 0x1014, 0x1015)

    def __init__(
        self,
        expose: Expose,
        *,
        names: CameraNames | None = None,
        time_scale: float = 1.0,
        raw: bool = True,
        faults: CameraFaults | None = None,
    ) -> None:
        self.lock = threading.RLock()
        self.faults = faults or CameraFaults()
        self.names = names or self.usual_names
        self.time_scale = time_scale
        self.card = Card()
        if not raw:
            self.capture_formats = (JPEG,)
        self.battery_percent = 90
        self.exposures = 0
        self.last_exposure_s = 0.0
        self.exposing = False
        self.answered: Counter[int] = Counter()
        self.stopped = threading.Event()
        self.on_event: Callable[[int, tuple[int, ...]], None] = lambda code, parameters: None
        self.on_drop: Callable[[], None] = lambda: None
        self._expose = expose
        self._open = False
        self._picture = 0
        self._held: tuple[ExposedPicture, float] | None = None

        self.power_on()

    def power_on(self) -> None:
        """Settings as after the battery was put in."""

    @property
    def pictures_on_card(self) -> int:
        """How many files the card holds."""
        return sum(bool(stored.data) for stored in self.card.objects.values())

    def disconnected(self) -> None:
        """The connection ended without goodbye."""
        with self.lock:
            self._open = False
            self.session_ended()

    def session_ended(self) -> None:
        """The session was closed, or its connection ended: what lasts no longer than a session ends."""

    def answer(self, code: int, parameters: tuple[int, ...], data: bytes) -> PtpOutcome:
        """Do one operation. Raises Gone where a fault ends the connection."""
        with self.lock:
            self.answered[code] += 1
            if code not in self._common and code not in self.operations:
                return PtpOutcome(NOT_SUPPORTED)
            if not self._open and code not in (0x1001, 0x1002):
                return PtpOutcome(NOT_OPEN)
            padded = parameters + (0,) * (5 - len(parameters))
            outcome = self.standard(code, padded) if code in self._common else None
            return outcome if outcome is not None else self.vendor(code, padded, data)

    def standard(self, code: int, parameters: tuple[int, ...]) -> PtpOutcome | None:  # noqa: PLR0911
        """Operations of the standard that every family has; None for those that differ."""
        match code:
            case 0x1001:
                return PtpOutcome(data=self._device_info())
            case 0x1002:
                was_open, self._open = self._open, True
                return PtpOutcome(ALREADY_OPEN) if was_open else PtpOutcome()
            case 0x1003:
                self._open = False
                self.session_ended()
                return PtpOutcome()
            case 0x1004:
                return PtpOutcome(data=u32s(STORAGE))
            case 0x1005:
                return PtpOutcome(data=self.card.storage_info())
            case 0x1006:
                return PtpOutcome(parameters=(len(self.card.handles(parameters[1], parameters[2])),))
            case 0x1007:
                return PtpOutcome(data=u32s(*self.card.handles(parameters[1], parameters[2])))
            case 0x1008 | 0x1009 | 0x100A | 0x100B:
                return self._object(code, parameters[0])
            case _:
                return self._battery(code) if parameters[0] == 0x5001 else None

    def vendor(self, code: int, parameters: tuple[int, ...], data: bytes) -> PtpOutcome:
        """Everything else that is in ``operations``."""
        return PtpOutcome(NO_SUCH_PROPERTY)

    def partial(self, parameters: tuple[int, ...]) -> PtpOutcome:
        """GetPartialObject: handle, offset, most bytes."""
        stored = self.card.find(parameters[0])
        if stored is None:
            return PtpOutcome(NO_SUCH_HANDLE)
        piece = memoryview(stored.data)[parameters[1] : parameters[1] + parameters[2]]
        return PtpOutcome(parameters=(len(piece),), data=piece)

    def full(self) -> bool:
        return self.faults.card_full or self.card.free < max(
            (len(o.data) for o in self.card.objects.values()), default=1
        )

    def open_shutter(self, settings: ShotSettings, *, to_host: bool, bulb: bool = False) -> PtpOutcome:
        """Begin an exposure, unless a fault, a full card or the last one is in the way; ``bulb``: without an end."""
        if self.faults.take("busy") or self.exposing:
            return PtpOutcome(BUSY)
        if not to_host and self.full():
            return PtpOutcome(STORE_FULL)
        if self.faults.take("drop_before_exposure"):
            raise Gone
        self.exposing = True
        self.exposures += 1
        self._held = (ExposedPicture(settings, to_host), time.monotonic()) if bulb else None
        if not bulb:
            threading.Thread(target=self._shutter, args=(ExposedPicture(settings, to_host),), daemon=True).start()
        return PtpOutcome()

    def close_shutter(self) -> PtpOutcome:
        """End an exposure that was begun with ``bulb``; it has lasted as long as it has."""
        if self._held is None:
            return PtpOutcome(GENERAL_ERROR)
        (exposed, began), self._held = self._held, None
        seconds = (time.monotonic() - began) / (self.time_scale or 1.0)
        exposed.settings = replace(exposed.settings, exposure_s=seconds)
        threading.Thread(target=self._shutter, args=(exposed, 0.0), daemon=True).start()
        return PtpOutcome()

    def exposed(self, exposed: ExposedPicture) -> None:
        """Hook: the files are stored; tell the computer."""

    def _shutter(self, exposed: ExposedPicture, lasts_s: float | None = None) -> None:
        """The shutter's own thread: it stays open for its time, whatever happens to the connection."""
        until = time.monotonic() + (exposed.settings.exposure_s * self.time_scale if lasts_s is None else lasts_s)
        self.last_exposure_s = exposed.settings.exposure_s
        try:
            files = self._expose(exposed.settings)  # of a stage it lasts as long as the exposure, of a test no time
        except BaseException:
            self.exposing = False  # the picture is lost, but the camera still works
            raise
        while (left_s := until - time.monotonic()) > 0 and not self.stopped.is_set():
            self.stopped.wait(min(left_s, 1.0))
        if self.stopped.is_set():
            return
        with self.lock:
            self._picture = self._picture % 9999 + 1
            taken = time.strftime("%Y%m%dT%H%M%S")
            for format_code, ending, data in ((self.raw_format, self.raw_ending, files.raw), (JPEG, "JPG", files.jpeg)):
                if data is not None:
                    name = f"IMG_{self._picture:04d}.{ending}"
                    exposed.stored.append(
                        self.card.add_picture(format_code, name, data, taken, to_host=exposed.to_host)
                    )
            self.exposing = False
            if self.faults.take("drop_after_exposure"):
                self.on_drop()
            self.exposed(exposed)

    def _object(self, code: int, handle: int) -> PtpOutcome:
        stored = self.card.find(handle)
        if stored is None:
            return PtpOutcome(NO_SUCH_HANDLE)
        if code == 0x1008:
            return PtpOutcome(data=stored.info())
        if code == 0x1009:
            return PtpOutcome(data=stored.data)
        if code == 0x100A:
            return PtpOutcome(NO_THUMBNAIL)
        self.card.objects.pop(handle, None)
        self.card.waiting.pop(handle, None)
        return PtpOutcome()

    def _battery(self, code: int) -> PtpOutcome:
        level = self.battery_percent
        if code == 0x1015:
            return PtpOutcome(data=bytes([level]))
        return PtpOutcome(data=struct.pack("<HHBBBBBBB", 0x5001, 0x0002, 0, 100, level, 1, 0, 100, 1))

    def _device_info(self) -> bytes:
        codes = sorted({*self._common, *self.operations})
        names = self.names
        return b"".join(
            (
                struct.pack("<HIH", 100, self.vendor_extension, 100),
                text(""),
                struct.pack("<H", 0),
                u16s(*codes),
                u16s(*self.events),
                u16s(*self.properties),
                u16s(*self.capture_formats),
                u16s(0x3001, JPEG, self.raw_format),
                *(text(one) for one in (names.maker, names.model, names.firmware, names.serial)),
            )
        )
