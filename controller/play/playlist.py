"""Appearances in turn: which one, for how long, and which come after it."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice
from typing import Self

from controller.bundle.format import PlaylistEntry
from controller.core.errors import BundleError


class Playlist:
    """Steps through (appearance, seconds, fade_s) items, ``repeat`` times, or for ever if 0.

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
        """For how long it comes in over the one before; 0: at once."""
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
