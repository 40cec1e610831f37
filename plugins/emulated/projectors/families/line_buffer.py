"""Whole commands out of the bytes that arrive on a line."""

from __future__ import annotations

from typing import Final

_LONGEST: Final = 256


class LineBuffer:
    """Collects commands that end in one byte; with ``start``, each begins at that byte, after any noise, so
    no command may contain it later on."""

    def __init__(self, end: int, start: int | None = None) -> None:
        self._end, self._start = end, start
        self._line = bytearray()

    def feed(self, data: bytes) -> list[bytes]:
        """The commands that ``data`` completes, without their end."""
        lines = []
        for byte in data:
            if byte == self._end:
                lines.append(bytes(self._line))
                self._line.clear()
            elif byte == self._start:
                self._line[:] = bytes([byte])
            elif len(self._line) < _LONGEST:
                self._line.append(byte)
        return lines
