"""What the two families of camera bodies, generic and Canon EOS, have in common towards ``plugins.ptp_camera``."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from typing import Final, Protocol

from hal.deadline import Deadline
from hal.errors import DeviceError, DeviceGone, DeviceRefused, DeviceTimeout
from hal.ptp import Operation, broken, parse_handles
from hal.ptp_datasets import ObjectInfo
from hal.values import CameraCapabilities, ExposureSettings
from plugins.ptp_files import PendingFile, kind_of
from plugins.ptp_link import PtpLink, Reply, Sink, camera_busy, refused

LARGEST_PICTURE: Final = 1 << 30
"""Bytes; what claims to be larger is no photograph, and would only fill the disk."""
_EVERY_STORE: Final = 0xFFFF_FFFF


@dataclass(frozen=True, slots=True)
class Timing:
    """How patient the driver is, in seconds.

    ``answer_s``: for an ordinary answer; ``busy_s``: with a busy camera; ``margin_s``: for a picture, beyond twice its
    exposure; ``grace_s``: for an event, before asking for what it would have told; ``come_back_s``: for a lost camera
    to answer again, ``reconnect_s``: the same during a picture; ``keep_alive_s``: between two signs of life.
    """

    answer_s: float = 15.0
    busy_s: float = 20.0
    margin_s: float = 15.0
    grace_s: float = 1.0
    come_back_s: float = 2.0
    reconnect_s: float = 30.0
    keep_alive_s: float = 5.0


@dataclass(frozen=True, slots=True)
class Picture:
    """A file on the camera; ``waiting`` in its memory until its transfer is confirmed, else on the card."""

    handle: int
    format: int
    size: int
    filename: str
    waiting: bool = False


@dataclass(slots=True)
class Shot:
    """One press of the button. ``fired`` from just before the request until the camera says that it did nothing.

    ``known``: handles on the card before it; ``recovering``: the connection was lost since.
    """

    exposure_s: float
    known: frozenset[int] = frozenset()
    fired: bool = False
    fired_at_s: float = 0.0
    waiting_since_s: float = 0.0
    recovering: bool = False
    found: dict[int, Picture] = field(default_factory=dict)

    def fire(self) -> None:
        self.fired = True
        self.fired_at_s = self.waiting_since_s = time.monotonic()

    def not_fired(self) -> None:
        self.fired = False

    def resume(self) -> None:
        """Look for the picture on a new connection."""
        self.recovering = True
        self.waiting_since_s = time.monotonic()
        self.found.clear()

    def age_s(self) -> float:
        """Seconds since the button was pressed."""
        return time.monotonic() - self.fired_at_s

    def overdue(self, timing: Timing) -> bool:
        """Whether the picture should have been there by now: twice its exposure and a margin."""
        return time.monotonic() - self.waiting_since_s > 2 * self.exposure_s + timing.margin_s

    def missing(self) -> DeviceError:
        """The error for a picture that was fired and never came."""
        if self.recovering:
            return DeviceGone(
                "camera-shot-lost",
                what="The connection to the camera was lost during a picture, and the camera has no new one.",
                remedy="Check cable, network and battery, then take this picture again; it was not taken twice.",
            )
        return DeviceTimeout(
            "camera-no-picture",
            what="The camera was released but no picture came from it in time.",
            remedy="Check that its lens is on manual focus and its drive mode on single shot, then take it again.",
        )


class Channel:
    """A link, what the camera at its end can do, and patience with it."""

    def __init__(self, link: PtpLink, operations: frozenset[int], timing: Timing) -> None:
        self.link = link
        self.timing = timing
        self._operations = operations

    def has(self, operation: int) -> bool:
        return operation in self._operations

    def ask(
        self,
        operation: int,
        *parameters: int,
        doing: str,
        deadline: Deadline,
        data: bytes | None = None,
        sink: Sink | None = None,
        most: int | None = None,
        patience_s: float | None = None,
        meanwhile: Callable[[], object] | None = None,
    ) -> Reply:
        """Do an operation until it is done; a busy camera is asked again, ever more slowly, for ``busy_s``.

        ``doing`` completes "The camera refused to ..."; ``meanwhile`` runs between two attempts. Raises DeviceBusy,
        DeviceRefused, and what the link raises.
        """
        give_up = deadline.within(self.timing.busy_s)
        pause_s = 0.01
        while True:
            reply = self.once(
                operation, *parameters, deadline=deadline, data=data, sink=sink, most=most, patience_s=patience_s
            )
            if reply.ok:
                return reply
            if not reply.busy:
                raise refused(reply, doing)
            if give_up.passed:
                raise camera_busy(doing)
            if meanwhile is not None:
                meanwhile()
            give_up.sleep(pause_s)
            pause_s = min(0.5, 2 * pause_s)

    def once(
        self,
        operation: int,
        *parameters: int,
        deadline: Deadline,
        data: bytes | None = None,
        sink: Sink | None = None,
        most: int | None = None,
        patience_s: float | None = None,
    ) -> Reply:
        """Do an operation once and return whatever the camera answers."""
        until = deadline.within(self.timing.answer_s if patience_s is None else patience_s)
        if most is None:
            return self.link.transact(operation, *parameters, data=data, sink=sink, deadline=until)
        return self.link.transact(operation, *parameters, data=data, sink=sink, most=most, deadline=until)

    def handles(self, deadline: Deadline) -> frozenset[int]:
        """Every object on every card."""
        reply = self.ask(Operation.GET_OBJECT_HANDLES, _EVERY_STORE, 0, 0, doing="list its pictures", deadline=deadline)
        return frozenset(parse_handles(reply.data))

    def picture(self, handle: int, deadline: Deadline) -> Picture | None:
        """What lies under a handle, if it is a picture and ready; else None."""
        reply = self.once(Operation.GET_OBJECT_INFO, handle, deadline=deadline)
        if not reply.ok:
            return None
        info = ObjectInfo.parse(reply.data)
        if kind_of(info.format, info.filename) is None:
            return None
        return Picture(handle, info.format, info.size, info.filename)

    def download(
        self, picture: Picture, file: PendingFile, *, partly: int | None, block: int, deadline: Deadline
    ) -> None:
        """Stream a picture into ``file``, by operation ``partly`` in blocks, or in one piece where that is None.

        Raises ProtocolError where the camera sends another number of bytes than it announced.
        """
        if not 0 < picture.size <= LARGEST_PICTURE:
            raise broken(f"a picture of {picture.size} bytes")
        if partly is None:
            self.ask(
                Operation.GET_OBJECT,
                picture.handle,
                doing="send a picture",
                sink=file.write,
                most=picture.size,
                patience_s=deadline.left_s(),
                deadline=deadline,
            )
        while partly is not None and file.size < picture.size:
            start, count = file.size, min(block, picture.size - file.size)
            self.ask(
                partly,
                picture.handle,
                start,
                count,
                doing="send a picture",
                sink=file.write,
                most=count,
                deadline=deadline,
            )
            if not start < file.size <= start + count:
                raise broken(f"{file.size - start} bytes of a picture where {count} were asked for")
        if file.size != picture.size:
            raise broken(f"{file.size} bytes of a picture of {picture.size}")


class Body(Protocol):
    """One family of operations, on one open connection."""

    @property
    def capabilities(self) -> CameraCapabilities: ...

    def prepare(self, *, after_break: bool, deadline: Deadline) -> None:
        """Take control and learn what can be set; ``after_break`` where a connection was lost in the middle."""

    def configure(self, settings: ExposureSettings, *, deadline: Deadline) -> ExposureSettings:
        """See ``hal.interfaces.Camera.configure``."""

    def exposure_s(self, *, deadline: Deadline) -> float:
        """The exposure that is set now."""

    def release(self, shot: Shot, *, deadline: Deadline) -> None:
        """Press the button once. ``shot.fired`` says afterwards, also after an error, whether it may have fired."""

    def collect(self, shot: Shot, *, deadline: Deadline) -> list[Picture]:
        """Wait for the pictures of ``shot``."""

    def download(self, picture: Picture, file: PendingFile, *, deadline: Deadline) -> None:
        """Stream one picture into ``file``."""

    def done(self, picture: Picture, *, deadline: Deadline) -> None:
        """The picture is safe on this computer; the camera may forget it."""

    def leave(self, *, deadline: Deadline) -> None:
        """Give control back."""


def still_waiting(deadline: Deadline) -> None:
    """Raise DeviceTimeout where the caller's time is over before the picture came."""
    deadline.check(
        "camera-no-picture",
        what="The picture did not come from the camera in the time that was given.",
        remedy="Give it more than twice the exposure, and look whether the camera shows an error.",
    )


def nearest(allowed: Collection[float], wanted: float, *, setting: str) -> float:
    """The allowed value nearest to ``wanted`` in stops. Raises DeviceRefused when it is more than a stop away."""
    if not allowed:
        raise DeviceRefused(
            "camera-setting-fixed",
            what=f"The camera does not let its {setting} be set now.",
            remedy="Turn its mode dial to M, take it out of bulb and automatic modes, then try again.",
        )
    if math.isfinite(wanted) and wanted > 0:
        best = min(allowed, key=lambda value: abs(math.log2(value / wanted)))
        if abs(math.log2(best / wanted)) <= 1.0:
            return best
    raise DeviceRefused(
        "camera-setting-range",
        what=f"The camera has no {setting} of {wanted:g}; it has {min(allowed):g} to {max(allowed):g}.",
        remedy="Choose a value within its range.",
    )


def no_such_file(raw: bool) -> DeviceRefused:
    """The error for a kind of file that the body does not make."""
    return DeviceRefused(
        "camera-no-raw" if raw else "camera-no-jpeg",
        what=f"The camera does not make {'RAW' if raw else 'JPEG'} files.",
        remedy=f"Set raw = {'false' if raw else 'true'} for this camera.",
    )
