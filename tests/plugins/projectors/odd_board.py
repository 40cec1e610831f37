"""A control board that answers some questions otherwise than its family does, as single models do."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from plugins.emulated.projectors.board import Board

_LONGEST: Final = 256


class OddBoard:
    """Any board, except for ``answers``: by the bytes of a question, what is answered instead; None: no answer.

    ``heard``: those questions, in the order in which they were asked.
    """

    def __init__(self, board: Board, answers: Mapping[bytes, bytes | None]) -> None:
        self._board = board
        self._answers = answers
        self._tail = b""
        self.heard: list[bytes] = []

    def feed(self, data: bytes, *, busy: bool = False) -> list[bytes]:
        """See ``Board``."""
        sent = []
        for byte in data:
            usual = self._board.feed(bytes([byte]), busy=busy)
            self._tail = (self._tail + bytes([byte]))[-_LONGEST:]
            question = next((question for question in self._answers if self._tail.endswith(question)), None)
            if question is None:
                sent += usual
                continue
            self.heard.append(question)
            self._tail = b""
            answer = self._answers[question]
            sent += [] if answer is None else [answer]
        return sent

    def notices(self) -> list[bytes]:
        """See ``Board``."""
        return self._board.notices()
