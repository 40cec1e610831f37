"""What is played in turn, and when each picture of it is due where several players follow one clock."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from itertools import accumulate, islice
from typing import Any, Self

from controller.bundle.format import PlaylistEntry
from controller.core.errors import BundleError


class Playlist:
    """Steps through (appearance, seconds, fade_s) items, ``repeat`` times, or without end if 0.

    ``first_fade_s``: how long the first item comes in at the very beginning, None: as it says.
    """

    def __init__(
        self, items: Sequence[tuple[str, float, float]], repeat: int, first_fade_s: float | None = None
    ) -> None:
        self._items = tuple(items)
        self._first_fade_s = first_fade_s
        self._rounds_left = repeat if repeat else None
        self._at = 0
        self.look_ahead = 2

    @classmethod
    def suggested(cls, hints: Sequence[PlaylistEntry], repeat: int) -> Self:
        """What a bundle suggests. Raises BundleError("bundle-no-schedule") if that is nothing."""
        if not hints:
            raise BundleError(
                "bundle-no-schedule",
                what="The bundle contains no playlist.",
                remedy="Name the appearances to play, or publish the bundle again with a playlist.",
            )
        return cls([(hint.appearance, hint.duration_ms / 1000, hint.fade_ms / 1000) for hint in hints], repeat)

    def starts(self, first_tick: int, ticks: Callable[[float], int]) -> Timetable:
        """When each of its pictures is due, if the first is due at ``first_tick``."""
        lengths = [ticks(seconds) for _, seconds, _ in self._items]
        return Timetable(first_tick, lengths, self._rounds_left)

    def request(self) -> dict[str, Any]:
        """Its part of a ``sequence`` request; an item of no length is shown for good."""
        items = [[name, seconds or 1 + fade_s, fade_s] for name, seconds, fade_s in self._items]
        return {"items": items, "repeat": self._rounds_left or 0, "first_fade_s": self._first_fade_s}

    def seek(self, number: int) -> None:
        """Go to the picture of this number, counted from 0 over all rounds."""
        self._first_fade_s = None if number else self._first_fade_s
        self._at = number % len(self._items)

    @property
    def names(self) -> frozenset[str]:
        return frozenset(name for name, _, _ in self._items)

    @property
    def appearance(self) -> str:
        """The item that is to be presented, or is."""
        return self._items[self._at][0]

    @property
    def seconds(self) -> float:
        """How long it stays, its cross-fade included."""
        return self._items[self._at][1]

    @property
    def fade_s(self) -> float:
        """Seconds for which it fades in over the previous one; 0: at once."""
        return self._items[self._at][2] if self._first_fade_s is None else self._first_fade_s

    @property
    def upcoming(self) -> list[str]:
        """This item's appearance and the different ones that follow it, at most ``look_ahead`` in all."""
        ordered = (self._items[(self._at + step) % len(self._items)][0] for step in range(len(self._items)))
        return list(islice(dict.fromkeys(ordered), self.look_ahead))

    def has_others(self, appearance: str | None) -> bool:
        return bool(self.names - {appearance})

    def advance(self) -> bool:
        """Go to the next item; False when there is none."""
        self._first_fade_s = None
        if self._at + 1 < len(self._items):
            self._at += 1
            return True
        if self._rounds_left is not None:
            self._rounds_left -= 1
            if self._rounds_left <= 0:
                return False
        self._at = 0
        return True


class Timetable:
    """When each picture of a list is due, in ticks of a common clock; None rounds: without end."""

    def __init__(self, first_tick: int, lengths: Sequence[int], rounds: int | None) -> None:
        *self._starts, self._round = accumulate(lengths, initial=0)
        self._first_tick = first_tick
        self.last = math.inf if rounds is None else rounds * len(lengths) - 1

    def start(self, number: int) -> int:
        """The tick at which the picture of this number is due."""
        rounds, index = divmod(number, len(self._starts))
        return self._first_tick + rounds * self._round + self._starts[index]

    def number_at(self, tick: int) -> int:
        """The picture that is due at a tick: the first before the begin, the last after the end."""
        rounds, rest = divmod(max(0, tick - self._first_tick), self._round)
        return int(min(self.last, rounds * len(self._starts) + bisect_right(self._starts, rest) - 1))
