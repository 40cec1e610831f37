"""The interface of a PTP bus, and its error messages."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol

from hal.codecs.ptp.values import Answer
from hal.deadline import Deadline
from hal.errors import DeviceBusy, DeviceError, DeviceGone, DeviceRefused
from hal.notices import Notice
from hal.tape import Transcript

Sink = Callable[[memoryview], object]
"""Receives the bytes of a data phase in pieces; the memory is reused after it returns."""

MOST_IN_MEMORY: Final = 32 << 20
"""Bytes of a data phase that is not streamed: 8 million object handles would fit."""


_MOST_NOTICES: Final = 10_000


@dataclass(frozen=True, slots=True)
class Reply:
    """A finished transaction. ``data`` is empty if a sink received it."""

    code: int
    parameters: tuple[int, ...]
    data: bytes

    @property
    def busy(self) -> bool:
        return self.code in (Answer.DEVICE_BUSY, Answer.VENDOR_BUSY)

    @property
    def ok(self) -> bool:
        return self.code == Answer.OK


@dataclass(frozen=True, slots=True)
class LinkEvent:
    """An event from the camera."""

    code: int
    parameters: tuple[int, ...]


class Diary:
    """Corrected faults of a camera, for a journal; the oldest are dropped if they are not read."""

    def __init__(self, transcript: Transcript | None = None) -> None:
        self._notices: deque[Notice] = deque(maxlen=_MOST_NOTICES)
        self._transcript = transcript

    def add(self, code: str, what: str) -> None:
        self._notices.append(Notice.warning(code, what))
        if self._transcript is not None:
            self._transcript.remark(f"{code}: {what}")

    def take(self) -> list[Notice]:
        """Those since the last call, oldest first."""
        # No more than there are now, and one by one: another thread, which keeps the camera awake, may add to them.
        return [self._notices.popleft() for _ in range(len(self._notices))]


class PtpLink(Protocol):
    """One open connection to a camera. After any error but a refusal it is broken: close it and open another."""

    @property
    def broken(self) -> bool:
        """Whether the connection is broken."""

    def transact(
        self,
        operation: int,
        *parameters: int,
        data: bytes | None = None,
        sink: Sink | None = None,
        most: int = MOST_IN_MEMORY,
        deadline: Deadline,
    ) -> Reply:
        """Do one operation. ``data`` is sent; what comes back goes to ``sink``, else into the reply; ``most`` bytes.

        Raises DeviceGone, DeviceTimeout, ProtocolError or Cancelled; an answer other than OK is not an error here.
        """

    def events(self) -> list[LinkEvent]:
        """The events that have come since the last call; never waits. Raises DeviceGone."""

    def wait_event(self, seconds: float, *, deadline: Deadline) -> None:
        """Return when an event is there, or ``seconds`` have passed. Raises Cancelled."""

    def close(self) -> None: ...


def camera_off(where: str, why: str) -> DeviceGone:
    """No answer at the camera's address."""
    return DeviceGone(
        "camera-off",
        what=f"No camera answers at {where}: {why}.",
        remedy="Switch the camera on, check its cable or network and its battery, then try again.",
    )


def camera_lost(why: str) -> DeviceGone:
    """An open connection ended."""
    return DeviceGone(
        "camera-disconnected",
        what=f"The connection to the camera ended: {why}.",
        remedy="Check the cable or network and the battery, and switch automatic power-off off.",
    )


def camera_busy(what: str) -> DeviceBusy:
    return DeviceBusy(
        "camera-busy",
        what=f"The camera stayed busy and could not {what}.",
        remedy="Wait until its card light is off, close its menus, then try again.",
    )


def refused(reply: Reply, doing: str) -> DeviceError:
    """The error for an answer that is not OK; ``doing`` completes "The camera refused to ..."."""
    if reply.busy:
        return camera_busy(doing)
    if reply.code in (Answer.STORE_FULL, Answer.STORE_READ_ONLY, Answer.STORE_NOT_AVAILABLE):
        return card_full(reply.code)
    try:
        name = Answer(reply.code).name.lower().replace("_", " ")
    except ValueError:
        name = "unknown reason"
    return DeviceRefused(
        "camera-refused",
        what=f"The camera refused to {doing}: {name} (0x{reply.code:04x}).",
        remedy="Check the mode dial (M), the lens switch (manual focus) and the card, then try again.",
    )


def card_full(code: int) -> DeviceRefused:
    if code == Answer.STORE_FULL:
        return DeviceRefused(
            "card-full",
            what="The camera took no picture because its memory is full.",
            remedy="Empty or replace the card, then continue. Nothing was exposed.",
        )
    return DeviceRefused(
        "card-unusable",
        what="The camera took no picture because its card is missing or write-protected.",
        remedy="Insert a card, or unlock it, then continue. Nothing was exposed.",
    )
