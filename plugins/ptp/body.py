"""The common interface of the two families of camera bodies, generic and Canon EOS, for ``plugins.ptp.camera``."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Final, Protocol

from hal.codecs.ptp.datasets import ObjectInfo, StorageInfo
from hal.codecs.ptp.values import Operation, Property, broken, parse_handles
from hal.deadline import Deadline
from hal.errors import DeviceRefused
from hal.values import CameraCapabilities, CameraStatus, ExposureSettings
from plugins.camera_files import PendingFile, kind_of
from plugins.ptp.link import MOST_IN_MEMORY, Diary, PtpLink, Reply, Sink, camera_busy, refused
from plugins.ptp.shot import Picture, Shot, Timing

LARGEST_PICTURE: Final = 1 << 30
"""Maximum bytes of a photograph; a larger size is an error and would fill the disk."""
_EVERY_STORE: Final = 0xFFFF_FFFF
_LITTLE_SPACE: Final = 1 << 30
_LOW_BATTERY: Final = 25


@dataclass(frozen=True, slots=True)
class PictureStorage:
    """Where a camera stores pictures, and which: what a ``[camera]`` table says.

    ``to_card``: a Canon EOS stores on its card instead of sending straight to this computer; ``keep_on_card``: pictures
    stay on the card after they are safe here; ``both``: a JPEG with each RAW file, if the camera can.
    """

    to_card: bool = False
    keep_on_card: bool = False
    both: bool = False


@dataclass(frozen=True, slots=True)
class Download:
    """Where the data of an answer go: ``sink`` gets them in pieces; more than ``most_bytes`` are refused."""

    sink: Sink
    most_bytes: int


class Channel:
    """A link, the capabilities of its camera, and time limits.

    ``exposing_until_s``: the end, on the monotonic clock, of an abandoned exposure.
    """

    def __init__(
        self,
        link: PtpLink,
        timing: Timing,
        diary: Diary,
        *,
        operations: frozenset[int],
        properties: frozenset[int] = frozenset(),
    ) -> None:
        self.link = link
        self.timing = timing
        self.diary = diary
        self.exposing_until_s = 0.0
        self._operations = operations
        self._properties = properties

    def patience(self, deadline: Deadline) -> Deadline:
        """Time limit for asking a busy camera again: after the end of any abandoned exposure."""
        return deadline.within(max(0.0, self.exposing_until_s - time.monotonic()) + self.timing.busy_s)

    def has(self, operation: int) -> bool:
        return operation in self._operations

    def request(
        self,
        operation: int,
        *parameters: int,
        doing: str,
        deadline: Deadline,
        data: bytes | None = None,
        into: Download | None = None,
        patience_s: float | None = None,
        meanwhile: Callable[[], object] | None = None,
    ) -> Reply:
        """Do an operation until it succeeds; a busy camera is asked again, at growing intervals, for ``busy_s``.

        ``data`` is sent with it; what the camera sends goes ``into`` a download, without one into the reply.
        ``doing`` completes "The camera refused to ..."; ``meanwhile`` runs between two attempts. Raises DeviceBusy,
        DeviceRefused, and what the link raises.
        """
        give_up = self.patience(deadline)
        pause_s = 0.01
        while True:
            reply = self.once(operation, *parameters, deadline=deadline, data=data, into=into, patience_s=patience_s)
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
        into: Download | None = None,
        patience_s: float | None = None,
        note_busy: bool = True,
    ) -> Reply:
        """Do an operation once and return the camera's answer. ``note_busy``: a busy camera is worth a note."""
        until = deadline.within(self.timing.answer_s if patience_s is None else patience_s)
        began_s = time.monotonic()
        sink, most = (None, MOST_IN_MEMORY) if into is None else (into.sink, into.most_bytes)
        reply = self.link.transact(operation, *parameters, data=data, sink=sink, most=most, deadline=until)
        took_s = time.monotonic() - began_s
        if took_s > self.timing.slow_s and sink is None:
            self.diary.add("camera-slow", f"The camera took {took_s:.1f} s to answer operation 0x{operation:04x}.")
        if reply.busy and note_busy:
            self.diary.add("camera-busy", f"The camera was busy when asked for operation 0x{operation:04x}.")
        return reply

    def handles(self, deadline: Deadline) -> frozenset[int]:
        """Every object on every card."""
        listing = (Operation.GET_OBJECT_HANDLES, _EVERY_STORE, 0, 0)
        reply = self.request(*listing, doing="list its pictures", deadline=deadline)
        return frozenset(parse_handles(reply.data))

    def battery_percent(self, deadline: Deadline) -> int | None:
        """The standard battery level; None where the camera has none."""
        if Property.BATTERY_LEVEL not in self._properties:
            return None
        reply = self.once(Operation.GET_PROPERTY, Property.BATTERY_LEVEL, deadline=deadline)
        return min(100, reply.data[0]) if reply.ok and reply.data else None

    def status(self, battery_percent: int | None, warnings: list[str], deadline: Deadline) -> CameraStatus:
        """The card, with what else is known."""
        free_bytes = free_pictures = None
        if self.has(Operation.GET_STORAGE_IDS) and self.has(Operation.GET_STORAGE_INFO):
            stores = self.once(Operation.GET_STORAGE_IDS, deadline=deadline)
            # A store without a medium has a logical number of 0.
            present = [store for store in parse_handles(stores.data) if store & 0xFFFF] if stores.ok else []
            infos = [self.once(Operation.GET_STORAGE_INFO, store, deadline=deadline) for store in present[:8]]
            cards = [StorageInfo.parse(info.data) for info in infos if info.ok]
            if cards:
                free_bytes, free_pictures = sum(card.free for card in cards), sum(card.free_images for card in cards)
            if not any(card.writable for card in cards):
                warnings.append("card-unusable")
            elif free_bytes is not None and free_bytes < _LITTLE_SPACE:
                warnings.append("card-nearly-full")
        if battery_percent is not None and battery_percent <= _LOW_BATTERY:
            warnings.append("battery-low")
        return CameraStatus(battery_percent, free_bytes, free_pictures, tuple(warnings))

    def picture(self, handle: int, deadline: Deadline) -> Picture | None:
        """The object of a handle, if it is a finished picture; else None."""
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
            self.request(
                Operation.GET_OBJECT,
                picture.handle,
                doing="send a picture",
                into=Download(file.write, picture.size),
                patience_s=deadline.left_s(),
                deadline=deadline,
            )
        while partly is not None and file.size < picture.size:
            start, count = file.size, min(block, picture.size - file.size)
            self.request(
                partly,
                picture.handle,
                start,
                count,
                doing="send a picture",
                into=Download(file.write, count),
                deadline=deadline,
            )
            if not start < file.size <= start + count:
                raise broken(f"{file.size - start} bytes of a picture instead of {count}")
        if file.size != picture.size:
            raise broken(f"{file.size} bytes of a picture of {picture.size}")


class Body(Protocol):
    """One family of operations, on one open connection."""

    @property
    def capabilities(self) -> CameraCapabilities: ...

    def prepare(self, *, deadline: Deadline) -> None:
        """Take control and learn what can be set, whatever another connection was in the middle of when it ended."""

    def configure(self, settings: ExposureSettings, *, deadline: Deadline) -> ExposureSettings:
        """See ``hal.interfaces.Camera.configure``."""

    def exposure_s(self, *, deadline: Deadline) -> float:
        """The exposure that is set now."""

    def release(self, shot: Shot, *, deadline: Deadline) -> None:
        """Press the button once. Afterwards, also after an error, ``shot.fired`` is true if it may have fired."""

    def collect(self, shot: Shot, *, deadline: Deadline) -> list[Picture]:
        """Wait for the pictures of ``shot``."""

    def download(self, picture: Picture, file: PendingFile, *, deadline: Deadline) -> None:
        """Stream one picture into ``file``."""

    def done(self, picture: Picture, *, deadline: Deadline) -> None:
        """The picture is safe on this computer; the camera may delete it."""

    def keep_alive(self, *, deadline: Deadline) -> None:
        """Keep the camera awake."""

    def status(self, *, deadline: Deadline) -> CameraStatus:
        """See ``hal.interfaces.WatchedCamera``."""

    def live_view(self, *, deadline: Deadline) -> bytes:
        """See ``hal.interfaces.LiveViewCamera``."""

    def end_live_view(self, *, deadline: Deadline) -> None:
        """See ``hal.interfaces.LiveViewCamera``."""

    def leave(self, *, deadline: Deadline) -> None:
        """Release the camera."""


def still_waiting(deadline: Deadline) -> None:
    """Raise DeviceTimeout if the deadline passed before the picture came."""
    deadline.check(
        "camera-no-picture",
        what="The camera did not send the picture in time.",
        remedy="Allow more than twice the exposure time, and check whether the camera shows an error.",
    )


def nearest(allowed: Collection[float], wanted: float, *, setting: str) -> float:
    """The allowed value nearest to ``wanted`` in stops. Raises DeviceRefused when it is more than a stop away."""
    if not allowed:
        raise DeviceRefused(
            "camera-setting-fixed",
            what=f"The camera's {setting} can't be set now.",
            remedy="Turn its mode dial to M, leave bulb and automatic modes, then try again.",
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


def no_live_view() -> DeviceRefused:
    return DeviceRefused(
        "camera-no-live-view",
        what="The camera has no live view over its cable.",
        remedy="Use its viewfinder, or take a test picture to aim.",
    )


def no_such_file(raw: bool) -> DeviceRefused:
    """The error for a kind of file that the body does not support."""
    return DeviceRefused(
        "camera-no-raw" if raw else "camera-no-jpeg",
        what=f"The camera does not support {'RAW' if raw else 'JPEG'} files.",
        remedy=f"Set raw = {'false' if raw else 'true'} for this camera.",
    )
