"""Tapes: all traffic between this computer and its devices in one file (docs/reference/tape-format.md)."""

from __future__ import annotations

import base64
import contextlib
import re
import threading
import time
import zlib
from enum import Enum
from pathlib import Path
from typing import Final, TextIO

from hal.escapes import escaped


class Direction(Enum):
    """The direction of an entry: to the device, from it, or a remark."""

    SENT = ">"
    RECEIVED = "<"
    REMARK = "|"


HEADER: Final = "velatura tape 1"
MOST_BYTES: Final = 1 << 30
"""A tape ends at this size, so that it fills no disk."""
PACK_FROM: Final = 200
"""Longer pieces are packed."""
PACKED: Final = {Direction.SENT: "}", Direction.RECEIVED: "{"}
_PJLINK_GREETING: Final = re.compile(rb"PJLINK 1 [0-9A-Fa-f]{1,64}")
_PJLINK_DIGEST: Final = re.compile(rb"\A(?:[0-9A-Fa-f]{64}|[0-9A-Fa-f]{32})(?=%)")


class Tape:
    """One file for all devices of a session; every line is written at once and survives a crash.

    Raises ``OSError`` where the file can't be made. A full disk later ends the tape and not the session.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._began_s = time.monotonic()
        self._lock = threading.Lock()
        self._tracks = 0
        self._written = 0
        self._file: TextIO | None = path.open("w", encoding="ascii", buffering=1)
        self._write(HEADER)

    def track(self, kind: str, address: str, *, secrets: tuple[bytes, ...] = ()) -> Transcript:
        """A new track: ``kind`` is a word for how its bytes are to be understood, ``address`` the device's.

        Each of ``secrets`` is written as asterisks.
        """
        with self._lock:
            self._tracks += 1
            number = self._tracks
        self._line("+", number, f"{kind} {escaped(address.encode())}")
        return Transcript(self, number, kind, secrets)

    def close(self) -> None:
        with self._lock:
            if self._file is not None:
                with contextlib.suppress(OSError):
                    self._file.close()
                self._file = None

    def add(self, number: int, way: Direction, data: bytes) -> None:
        """Write one piece of a track."""
        if way in PACKED and len(data) >= PACK_FROM:
            self._line(PACKED[way], number, base64.b64encode(zlib.compress(data, 1)).decode())
        else:
            self._line(way.value, number, escaped(data))

    def _line(self, mark: str, number: int, text: str) -> None:
        self._write(f"{time.monotonic() - self._began_s:.6f} {mark} {number} {text}")

    def _write(self, line: str) -> None:
        with self._lock:
            if self._file is None:
                return
            self._written += len(line) + 1
            try:
                self._file.write(line + "\n" if self._written <= MOST_BYTES else "")
            except OSError:
                self._file = None


class Transcript:
    """Records what is said with one device, as a track of a tape."""

    def __init__(self, tape: Tape, number: int, kind: str, secrets: tuple[bytes, ...]) -> None:
        self._tape = tape
        self._number = number
        self._kind = kind
        self._secrets = tuple(secret for secret in secrets if secret)

    def sent(self, data: bytes) -> None:
        self._add(Direction.SENT, data)

    def received(self, data: bytes) -> None:
        self._add(Direction.RECEIVED, data)

    def remark(self, text: str) -> None:
        self._add(Direction.REMARK, text.encode("ascii", "backslashreplace"))

    def _add(self, way: Direction, data: bytes) -> None:
        self._tape.add(self._number, way, self._without_secrets(data))

    def _without_secrets(self, data: bytes) -> bytes:
        for secret in self._secrets:
            data = data.replace(secret, b"*" * len(secret))
        if self._kind == "pjlink":
            # A tape has no authentication: a digest could be used to guess the password.
            data = _PJLINK_DIGEST.sub(b"", _PJLINK_GREETING.sub(b"PJLINK 0", data))
        return data
