r"""Writes a tape. The format is docs/reference/tape-format.md; ``hal.tape.reading`` reads it."""

from __future__ import annotations

import base64
import contextlib
import re
import threading
import time
import zlib
from pathlib import Path
from typing import Final, TextIO

from hal.escapes import escaped
from hal.transcript import Direction, Transcript

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

    def track(self, kind: str, address: str, *, secrets: tuple[bytes, ...] = ()) -> TapeTrack:
        """A new track: ``kind`` is a word for how its bytes are to be understood, ``address`` the device's.

        Each of ``secrets`` is written as asterisks.
        """
        with self._lock:
            self._tracks += 1
            number = self._tracks
        self._line("+", number, f"{kind} {escaped(address.encode())}")
        return TapeTrack(self, number, kind, secrets)

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


class TapeTrack(Transcript):
    """A transcript that is a track of a tape; it keeps nothing in memory. ``close`` leaves the tape open."""

    whole = True

    def __init__(self, tape: Tape, number: int, kind: str, secrets: tuple[bytes, ...]) -> None:
        super().__init__(keep=1)
        self._tape = tape
        self._number = number
        self._kind = kind
        self._secrets = tuple(secret for secret in secrets if secret)

    def _add(self, way: Direction, data: bytes) -> None:
        self._tape.add(self._number, way, self._without_secrets(data))

    def _without_secrets(self, data: bytes) -> bytes:
        for secret in self._secrets:
            data = data.replace(secret, b"*" * len(secret))
        if self._kind == "pjlink":
            # A tape has no authentication: a digest could be used to guess the password.
            data = _PJLINK_DIGEST.sub(b"", _PJLINK_GREETING.sub(b"PJLINK 0", data))
        return data
