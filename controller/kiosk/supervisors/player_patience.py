"""How long a player may be silent before it is ended: longer where ending it did not help."""

from __future__ import annotations

from collections import deque
from typing import Final

MOST_MISSES: Final = 2
"""Unanswered questions in a row after which a player counts as hung."""
REFUSED_MORE: Final = 2
"""So many more where the connection fails: a player that is about to end refuses it, too."""
LONGER: Final = (1, 2, 4, 8)
"""So many times as many questions, by how often it was ended in the last ``REMEMBERED_S``."""
REMEMBERED_S: Final = 300.0


class Patience:
    """Counts the questions in a row that a player left unanswered, and its ends because of that.

    A player whose answers are late or lost, because the computer is busy for example, may show its picture all the
    time. Each end makes that black, and if it did not help, the next one will not either.
    """

    def __init__(self) -> None:
        self._misses = 0
        self._ends_s: deque[float] = deque(maxlen=len(LONGER) - 1)

    def begins(self) -> None:
        """The player was started, or it answered."""
        self._misses = 0

    def ends(self, now_s: float, *, as_wanted: bool, refused: bool = False) -> bool:
        """Count one more question without an answer; whether the player is to be ended.

        ``as_wanted``: it showed what it should when it answered last. Where it did not, nothing speaks for waiting.
        """
        self._misses += 1
        lately = sum(now_s - end_s < REMEMBERED_S for end_s in self._ends_s)
        most = MOST_MISSES * (LONGER[lately] if as_wanted else 1) + REFUSED_MORE * refused
        if self._misses < most:
            return False
        self._ends_s.append(now_s)
        return True
