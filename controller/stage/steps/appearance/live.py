"""Live mode: makes frames from a source's pictures, always the newest, and counts late and bad ones."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final, Protocol

import numpy as np

from controller.core.arrays import ByteImage
from controller.core.errors import UsageError
from controller.optics.solve.scaling.interactive import Interactive
from controller.stage.live import LivePicture, LiveSource, fitted

IDLE_S: Final = 0.002
REPORT_EVERY_S: Final = 1.0
DELAYS: Final = 4096
"""The delays of this many latest pictures are kept."""
BUFFERS: Final = 3
"""One shown, one waiting, one being made."""

Frames = list[ByteImage]


class Maker(Protocol):
    """Converts a source's picture for the player."""

    def blank(self) -> Frames:
        """The buffer for ``make``; its content is undefined."""

    def make(self, picture: LivePicture, into: Frames) -> None: ...


class FrameMaker:
    """Makes the projectors' frames by base and scale on the CPU; ``brightness``: the radiance of white."""

    def __init__(self, scaler: Interactive, brightness: float) -> None:
        self._scaler, self._brightness = scaler, brightness

    def blank(self) -> Frames:
        """See ``Maker``."""
        return self._scaler.blank()

    def make(self, picture: LivePicture, into: Frames) -> None:
        """See ``Maker``."""
        self._scaler.show_picture(fitted(picture.pixels, self._scaler.maps.target_px), self._brightness, into)


class TargetMaker:
    """Scales pictures to the targets' size, (width, height), for a player that makes the frames in shaders."""

    def __init__(self, target_px: tuple[int, int]) -> None:
        self._target_px = target_px

    def blank(self) -> Frames:
        """See ``Maker``."""
        return [np.empty((self._target_px[1], self._target_px[0], 3), np.uint8)]

    def make(self, picture: LivePicture, into: Frames) -> None:
        """See ``Maker``."""
        np.copyto(into[0], fitted(picture.pixels, self._target_px))


@dataclass(slots=True)
class LiveFigures:
    """Figures about a source's pictures; ``trouble``: the error of the last ``bad`` one."""

    made: int = 0
    late: int = 0
    bad: int = 0
    trouble: str | None = None
    seconds: float = 0.0
    delays_s: deque[float] = field(default_factory=lambda: deque(maxlen=DELAYS))

    def as_json(self) -> dict[str, Any]:
        """As a dictionary for output; ``delay`` is from a picture's due time to the delivery of its frames."""
        delays = np.array(self.delays_s or [0.0])
        return {
            "made": self.made,
            "late": self.late,
            "bad": self.bad,
            "trouble": self.trouble,
            "pictures_per_s": self.made / self.seconds if self.seconds > 0 else 0.0,
            "delay_p50_ms": 1e3 * float(np.percentile(delays, 50)),
            "delay_p99_ms": 1e3 * float(np.percentile(delays, 99)),
        }


class _Mailbox:
    """Holds one set of frames; a newer set replaces it. Buffers are reused."""

    def __init__(self, buffers: list[Frames]) -> None:
        self._changed = threading.Condition()
        self._free = buffers
        self._full: tuple[Frames, float, int] | None = None
        self.ended = False
        self.error: BaseException | None = None
        self.bad = 0
        self.trouble: str | None = None

    def buffer(self) -> Frames:
        with self._changed:
            return self._free.pop()

    def put(self, frames: Frames, due_s: float, late: int) -> None:
        with self._changed:
            if self._full is not None:
                old, _, before = self._full
                self._free.append(old)
                late += before + 1
            self._full = frames, due_s, late
            self._changed.notify_all()

    def give_back(self, frames: Frames) -> None:
        with self._changed:
            self._free.append(frames)

    def take(self, timeout_s: float) -> tuple[Frames, float, int] | None:
        with self._changed:
            self._changed.wait_for(lambda: self._full is not None or self.ended, timeout_s)
            found, self._full = self._full, None
            return found

    def pass_over(self, error: UsageError) -> None:
        """Count a picture that can't be shown; the last good one stays."""
        self.bad, self.trouble = self.bad + 1, f"{error.what} {error.remedy}"

    @property
    def empty_for_good(self) -> bool:
        """Whether it is closed and empty; a set that came just before closing can still be taken."""
        with self._changed:
            return self.ended and self._full is None

    def end(self, error: BaseException | None) -> None:
        with self._changed:
            self.ended, self.error = True, error
            self._changed.notify_all()


def run_live(
    source: LiveSource,
    maker: Maker,
    show: Callable[[Frames], object],
    *,
    rate_hz: float,
    seconds: float | None = None,
    report: Callable[[LiveFigures], None] = lambda figures: None,
) -> LiveFigures:
    """Show the pictures of ``source``, made by ``maker``, until it ends, ``seconds`` have passed or ``report`` raises.

    Parameters
    ----------
    show : called with the finished frames; their buffer may be overwritten after that
    rate_hz : maximum rate of pictures; those that are due in between count as late
    report : called about once a second, and may raise to stop

    A picture for which the source raises UsageError is skipped and counted as bad. Raises other errors of the source,
    ``show`` and ``report``, after the source is closed.
    """
    box = _Mailbox([maker.blank() for _ in range(BUFFERS)])
    stop = threading.Event()
    began_s = time.monotonic()
    worker = threading.Thread(target=_make, args=(source, maker, box, stop, rate_hz, began_s), name="live")
    worker.start()
    figures = LiveFigures()
    reported_s = began_s
    try:
        while seconds is None or time.monotonic() - began_s < seconds:
            taken = box.take(0.1)
            if taken is not None:
                frames, due_s, late = taken
                show(frames)
                box.give_back(frames)
                figures.made += 1
                figures.late += late
                figures.delays_s.append(time.monotonic() - due_s)
            elif box.empty_for_good:
                break
            figures.seconds = time.monotonic() - began_s
            figures.bad, figures.trouble = box.bad, box.trouble
            if time.monotonic() - reported_s >= REPORT_EVERY_S:
                reported_s = time.monotonic()
                report(figures)
    finally:
        stop.set()
        worker.join()
        source.close()
    if box.error is not None:
        raise box.error
    return figures


def _make(
    source: LiveSource, maker: Maker, box: _Mailbox, stop: threading.Event, rate_hz: float, began_s: float
) -> None:
    error: BaseException | None = None
    number = -1
    try:
        while not stop.is_set() and not source.ended:
            now_s = time.monotonic() - began_s
            turn = int(now_s * rate_hz)
            if turn == number:
                stop.wait(min(IDLE_S, 0.25 / rate_hz))
                continue
            try:
                picture = source.next(now_s)
            except UsageError as bad:
                box.pass_over(bad)
                continue
            if picture is None:
                stop.wait(IDLE_S)
                continue
            number = turn
            frames = box.buffer()
            maker.make(picture, frames)
            box.put(frames, began_s + now_s, picture.skipped)
    except BaseException as raised:  # noqa: BLE001 - raised again where the pictures are shown
        error = raised
    box.end(error)
