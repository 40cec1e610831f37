"""What is presented next: a set of frames, or an appearance once it is decoded, at once or faded in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

from controller.core.errors import VelaturaError
from controller.play.frames import FrameSet


@dataclass(frozen=True, slots=True)
class PresentedSet:
    """A set became visible: the player's count of sets, and the moment in monotonic seconds."""

    sequence: int
    at_s: float


ResultCallback: TypeAlias = Callable[[PresentedSet | VelaturaError], None]
"""Called once with the result of a request: presented, or the reason why not."""


@dataclass(slots=True)
class PendingPresentation:
    """What is presented next, at a tick of the grid.

    ``frames`` None: the appearance is taken from the cache once it is decoded. ``fade_s``: it comes in over what is
    shown, in ``steps``, the first at ``begun_tick``; ``share`` of it is shown already. ``paced``: it is one of a
    sequence, whose intervals are measured. ``prepare``: makes the output ready where that does not take ``frames``.
    """

    showing: str
    appearance: str | None
    frames: FrameSet | None
    tick: int
    on_result: ResultCallback | None
    fade_s: float = 0.0
    paced: bool = False
    prepare: Callable[[], None] | None = None
    begun_tick: int | None = None
    steps: int = 1
    share: float = 0.0

    def begin(self, steps: int) -> None:
        """The first step is presented at ``tick``."""
        self.begun_tick, self.steps = self.tick, steps

    def delay(self, tick: int) -> None:
        """It begins at ``tick`` after all."""
        self.tick = tick
        self.begun_tick = None if self.begun_tick is None else tick

    def step(self, next_tick: int) -> bool:
        """Its step of ``tick`` is shown. Whether that was the last; else the next is not before ``next_tick``."""
        self.share = self.next_share
        if self.share >= 1:
            return True
        self.tick = min(self.first_tick + self.steps - 1, max(self.tick + 1, next_tick))
        return False

    @property
    def first_tick(self) -> int:
        """When its first step is or was presented."""
        return self.tick if self.begun_tick is None else self.begun_tick

    @property
    def next_share(self) -> float:
        """How much of it is shown at ``tick``: by the clock, so a slow machine leaves out steps and not time."""
        return 1.0 if self.begun_tick is None else min(1.0, (self.tick - self.begun_tick + 1) / self.steps)
