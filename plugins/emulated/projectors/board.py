"""A projector's control board: what it does with the bytes that it hears. Bytes in, bytes out.

The families (``boards_text``, ``boards_marked``, ``boards_binary``) are each written from the makers' command lists
(docs/reference/projectors.md) and share no parser with the drivers, so that a common mistake would show. The lamp is
the only state that they act on.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar, Final, Protocol

from plugins.emulated.projectors.lamp import EmulatedLamp

_LONGEST: Final = 256


class Board(Protocol):
    """The control board of a projector."""

    def feed(self, data: bytes, *, busy: bool = False) -> list[bytes]:
        """The answers to the commands that ``data`` completes, one an element; ``busy``: each is refused."""

    def notices(self) -> list[bytes]:
        """Lines that are due now, unasked."""


class LampBoard(ABC):
    """What the boards have in common: they collect whole commands, answer each, and send nothing unasked."""

    def __init__(self, lamp: EmulatedLamp) -> None:
        self._lamp = lamp
        self._received = bytearray()

    def feed(self, data: bytes, *, busy: bool = False) -> list[bytes]:
        """See ``Board``."""
        self._received += data
        answers = []
        while (command := self._take()) is not None:
            answers += self._answers(command, busy)
        return answers

    def notices(self) -> list[bytes]:
        """See ``Board``."""
        return []

    @abstractmethod
    def _take(self) -> bytes | None:
        """Remove the next whole command from ``_received``, with any noise before it; None while there is none."""

    @abstractmethod
    def _answers(self, command: bytes, busy: bool) -> list[bytes]:
        """The answers to one command."""

    def _cut(self, length: int) -> bytes | None:
        """The first ``length`` received bytes; None while there are fewer."""
        if len(self._received) < length:
            return None
        command = bytes(self._received[:length])
        del self._received[:length]
        return command


class LineBoard(LampBoard):
    """A board whose commands end in one byte, ``end``; with ``start``, each begins at that byte, after any noise, so
    no command may contain it later on. Commands come without their end."""

    end: ClassVar = b"\r"
    start: ClassVar = b""

    def _take(self) -> bytes | None:
        line, end, rest = bytes(self._received).partition(self.end)
        if not end:
            del self._received[:-_LONGEST]
            return None
        self._received[:] = rest
        return line[max(0, line.rfind(self.start)) :] if self.start else line
