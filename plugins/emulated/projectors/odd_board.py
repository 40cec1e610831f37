"""A control board that answers some questions otherwise than its family does, as single models do."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from plugins.emulated.projectors.serial import Board

_KEPT: Final = 64


class OddBoard:
    """Any board, but for ``answers``: by the bytes of a question, what is answered instead; None: nothing at all.

    ``heard``: those questions, in the order in which they were asked.
    """

    def __init__(self, board: Board, answers: Mapping[bytes, bytes | None]) -> None:
        self._board = board
        self._answers = answers
        self._tail = b""
        self.heard: list[bytes] = []

    def feed(self, data: bytes, *, busy: bool = False) -> list[bytes]:
        said = []
        for byte in data:
            usual = self._board.feed(bytes([byte]), busy=busy)
            self._tail = (self._tail + bytes([byte]))[-_KEPT:]
            asked = next((question for question in self._answers if self._tail.endswith(question)), None)
            if asked is None:
                said += usual
                continue
            self.heard.append(asked)
            self._tail = b""
            answer = self._answers[asked]
            said += [] if answer is None else [answer]
        return said

    def notices(self) -> list[bytes]:
        return self._board.notices()
