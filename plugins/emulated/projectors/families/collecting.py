"""What boards share: whole commands out of bytes, and whether a lamp is broken."""

from __future__ import annotations

from typing import Final

from plugins.emulated.projectors.lamp import EmulatedLamp, LampPhase

_LONGEST: Final = 256
BURNING: Final = (LampPhase.WARMING, LampPhase.LIT)


class Lines:
    """Collects commands that end in one byte; with ``start``, each begins at that byte, after any noise, so
    no command may contain it later on."""

    def __init__(self, end: int, start: int | None = None) -> None:
        self._end, self._start = end, start
        self._line = bytearray()

    def whole(self, data: bytes) -> list[bytes]:
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


def broken(lamp: EmulatedLamp) -> bool:
    """Whether the projector stands in an error state: it was to burn, and its lamp failed or is too hot."""
    return lamp.phase not in BURNING and (lamp.too_hot or (lamp.failed and lamp.strikes > 0))
