"""Whether a stage is to be open: by its hours, and by what people said."""

from __future__ import annotations

from collections.abc import Callable

from controller.simulate.judge.calendar import Calendar


class Wanted:
    """``truth``: Unix seconds as they are; ``override``: what people said, and until when."""

    def __init__(self, calendar: Calendar, truth: Callable[[], float]) -> None:
        self._calendar, self._truth = calendar, truth
        self._edge_s, self._open = -1.0, False
        self.override: tuple[bool, float] | None = None

    def open(self) -> bool:
        """Whether it is to be open now."""
        truth_s = self._truth()
        if truth_s >= self._edge_s:
            self._open, self._edge_s = self._calendar.open(truth_s), self._calendar.changes_s(truth_s)
        if self.override is not None and truth_s >= self.override[1]:
            self.override = None
        return self._open if self.override is None else self.override[0]

    def edge_s(self) -> float:
        """When hours change next (Unix seconds)."""
        self.open()
        return self._edge_s

    def use(self, calendar: Calendar) -> None:
        """New hours: what a person said stays, until they change next, if they say the same as the old ones."""
        said = self._calendar.open(self._truth())
        self._calendar, self._edge_s = calendar, -1.0
        if self.override is not None:
            now_says = calendar.open(self._truth())
            self.override = (self.override[0], calendar.changes_s(self._truth())) if now_says is said else None
        self.open()

    def say(self, wanted: bool) -> None:
        """A person opened or closed the stage, until its hours change next."""
        self.override = None
        if self.open() is not wanted:
            self.override = (wanted, self._edge_s)
