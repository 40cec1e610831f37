"""The interrupt pipe of a camera on USB: a thread reads the events, and closes the pipes if it is the last user.

It reads in short waits, because another thread can't end a read.
"""

from __future__ import annotations

import threading
from collections import deque
from typing import Final

from hal.codecs.ptp import usb as ptp_usb
from hal.errors import DeviceGone, ProtocolError
from plugins.ptp.link import LinkEvent
from plugins.ptp.usb.pipes import Pipes, PipeStalled

_SLICE_S: Final = 0.1
_MOST_EVENTS: Final = 10_000


class InterruptReader:
    """Reads from ``start`` to ``close``. ``ended``: why the camera is gone, None while it is connected."""

    def __init__(self, pipes: Pipes) -> None:
        self._pipes = pipes
        self._released = False
        self._events: deque[LinkEvent] = deque(maxlen=_MOST_EVENTS)
        self._news = threading.Condition()
        self.ended: DeviceGone | None = None
        self._stop = threading.Event()
        self._reader = threading.Thread(target=self._read, name="ptp-usb-events", daemon=True)

    def start(self) -> None:
        self._reader.start()

    def taken(self) -> list[LinkEvent]:
        """What has come since the last call."""
        with self._news:
            found = list(self._events)
            self._events.clear()
        return found

    def wait(self, seconds: float) -> bool:
        """Whether there are events, or news came within ``seconds``."""
        with self._news:
            return bool(self._events) or self._news.wait(seconds)

    def close(self) -> None:
        """Stop reading, and close the pipes; may be called before ``start``."""
        self._stop.set()
        if self._reader.is_alive():
            self._reader.join(3 * _SLICE_S)
        if not self._reader.is_alive():
            self._release()

    def _release(self) -> None:
        """Close the pipes once. If a dead bus still blocks the reader, the reader closes them later."""
        with self._news:
            released, self._released = self._released, True
        if not released:
            self._pipes.close()

    def _read(self) -> None:
        try:
            self._read_until_stopped()
        finally:
            if self._stop.is_set():
                self._release()

    def _read_until_stopped(self) -> None:
        stalls = 0
        while not self._stop.is_set():
            try:
                data = self._pipes.read_event(_SLICE_S)
                stalls = 0
                if data:
                    code, parameters = ptp_usb.parse_event(data)
                    with self._news:
                        self._events.append(LinkEvent(code, parameters))
                        self._news.notify_all()
            except ProtocolError:
                continue  # the bodies query the state after a lost event
            except PipeStalled:
                stalls += 1
                self._stop.wait(min(1.0, 0.05 * stalls))
            except DeviceGone as gone:
                with self._news:
                    self.ended = gone
                    self._news.notify_all()
                return
