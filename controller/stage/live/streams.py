"""Streams that come at their own pace, from a network or a camera: read by a thread, always the newest picture."""

from __future__ import annotations

import contextlib
import re
import threading
from collections.abc import Callable
from typing import Final, Protocol

from controller.core.arrays import ByteImage
from controller.core.errors import UsageError
from controller.stage.live.sources import LivePicture

RETRY_S: Final = 2.0
"""From a loss to the next attempt."""
FIRST_S: Final = 15.0
"""A stream must have shown a picture by then, or it is refused."""
CLOSE_S: Final = 2.0
"""A reader that hangs in a library is left behind after that; it ends by itself."""
_SCHEME: Final = re.compile(r"(?:rtsp|rtsps|udp|ndi)://\S.*", re.IGNORECASE)
_CAMERA: Final = re.compile(r"/dev/video\d+")
_PASSWORD: Final = re.compile(r"^((?:rtsps?|udp)://)[^/@]*@", re.IGNORECASE)


class Lost(Exception):
    """A stream that can't be opened or read; ``str`` says why, in a few words."""


class Reader(Protocol):
    """One connection to a stream."""

    def read(self) -> ByteImage:
        """The next picture, (rows, columns, 3) RGB uint8. Waits a few seconds at most, then raises Lost."""

    def close(self) -> None: ...


def is_stream(source: str) -> bool:
    """Whether ``source`` is the address of a stream and no file or folder."""
    return bool(_SCHEME.fullmatch(source) or _CAMERA.fullmatch(source))


def without_password(source: str) -> str:
    """The address as messages show it."""
    return _PASSWORD.sub(r"\1", source)


class StreamSource:
    """``LiveSource`` of a stream. It never waits, and never ends: a lost stream is opened again every ``RETRY_S``.

    Meanwhile there is no picture, so the last one stays.
    """

    def __init__(self, name: str, open_it: Callable[[], Reader], *, retry_s: float = RETRY_S) -> None:
        """``open_it``: connects; it may wait a few seconds, then raises Lost. ``name``: for messages."""
        self._name, self._open, self._retry_s = name, open_it, retry_s
        self._changed = threading.Condition()
        self._stopped = threading.Event()
        self._newest: ByteImage | None = None
        self._count = self._given = 0
        self._lost: str | None = None
        self._there = False
        self._why = "nothing was received"
        # A daemon, so that a library that hangs does not keep the program from ending.
        self._thread = threading.Thread(target=self._run, name="live stream", daemon=True)
        self._thread.start()

    def wait_for_picture(self, timeout_s: float = FIRST_S) -> None:
        """Return once a picture has come. Raises UsageError("live-source-unreadable") if none does in time."""
        with self._changed:
            if self._changed.wait_for(lambda: self._count > 0, timeout_s):
                return
            why = self._why
        raise UsageError(
            "live-source-unreadable",
            what=f"No picture came from {self._name} ({why}).",
            remedy="Check the address, and that the other program sends.",
        )

    def next(self, at_s: float) -> LivePicture | None:
        """See ``LiveSource``. Raises UsageError("live-source-gone") once for each time that the stream was lost."""
        del at_s  # the stream has a clock of its own
        with self._changed:
            if self._count != self._given and self._newest is not None:
                skipped = self._count - self._given - 1 if self._given else 0
                self._given = self._count
                return LivePicture(self._newest, self._count - 1, skipped)
            why, self._lost = self._lost, None
        if why is not None:
            raise UsageError(
                "live-source-gone",
                what=f"The stream {self._name} was lost ({why}). The last picture stays.",
                remedy="Restart the program or camera that sends it; it is shown again by itself.",
            )
        return None

    @property
    def ended(self) -> bool:
        """False: a stream may come back at any time."""
        return False

    def close(self) -> None:
        """Stop reading."""
        self._stopped.set()
        self._thread.join(CLOSE_S)

    def _run(self) -> None:
        while not self._stopped.is_set():
            try:
                with contextlib.closing(self._open()) as reader:
                    while not self._stopped.is_set():
                        self._take(reader.read())
            except Lost as lost:
                with self._changed:
                    # Told once: a stream that stays away is no further bad picture at each attempt.
                    self._lost = str(lost) if self._there else self._lost
                    self._there, self._why = False, str(lost)
                self._stopped.wait(self._retry_s)

    def _take(self, picture: ByteImage) -> None:
        with self._changed:
            self._newest, self._lost, self._there = picture, None, True
            self._count += 1
            self._changed.notify_all()
