"""Three channels of a lighting desk that show appearances: which source counts, and what its levels ask for. No I/O."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, Never

from pydantic import Field

from controller.core.errors import VelaturaError
from controller.kiosk.building.protocol import NetworkOptions
from controller.kiosk.building.verbs import Verbs
from controller.kiosk.state import KioskState
from controller.run.state_machine import State

LOST_S: Final = 2.5
"""E1.31 (ANSI E1.31-2018, 6.7.1): a source that is silent for so long is lost."""
SETTLE_S: Final = 0.15
"""A moving fader passes appearances that are not meant to be shown."""
DIM_EVERY_S: Final = 0.25
IN_TURN: Final = 255
FADE_STEP_S: Final = 0.1
_OPEN: Final = (State.READY.value, State.PLAYING.value, State.DEGRADED.value)


@dataclass(frozen=True, slots=True)
class Frame:
    """One packet: ``source`` its sender's identity, ``sequence`` 0..255 or None if packets are not counted, ``levels``
    those of the three channels.
    """

    source: object
    priority: int
    sequence: int | None
    ended: bool
    levels: tuple[int, int, int]


class Sources:
    """The source with the highest priority counts; of several, the one that came first, until it is lost."""

    def __init__(self, *, lost_s: float = LOST_S) -> None:
        """A source that is silent for more than ``lost_s`` is lost."""
        self._lost_s = lost_s
        self._seen: dict[object, tuple[float, Frame]] = {}

    def take(self, frame: Frame, now_s: float) -> None:
        """``now_s``: monotonic seconds. A packet that comes too late, after a newer one, is ignored."""
        self._forget(now_s)
        before = self._seen.get(frame.source)
        if before is not None and _overtaken(frame.sequence, before[1].sequence):
            return
        if frame.ended:
            self._seen.pop(frame.source, None)
        else:
            self._seen[frame.source] = now_s, frame

    def levels(self, now_s: float) -> tuple[int, int, int] | None:
        """Of the source that counts; None without one."""
        self._forget(now_s)
        frames = [frame for _, frame in self._seen.values()]
        # The first of the highest: a dictionary keeps the order in which its keys came.
        return max(frames, key=lambda frame: frame.priority).levels if frames else None

    def _forget(self, now_s: float) -> None:
        self._seen = {source: seen for source, seen in self._seen.items() if now_s - seen[0] <= self._lost_s}


def _overtaken(sequence: int | None, newest: int | None) -> bool:
    if sequence is None or newest is None:
        return False
    return -20 < (sequence - newest + 128) % 256 - 128 <= 0


Verb = tuple[str, dict[str, Any]]


class Follower:
    """From levels to verbs. It never opens or closes the stage; what it asked for is asked again when that opens.

    The first channel picks: 0 nothing, n the n-th appearance, 255 the playlist; the second dims; the third is the fade
    of the next change in tenths of a second. ``dark_when_lost``: black while no source is there, else all stays.
    """

    def __init__(self, *, dark_when_lost: bool) -> None:
        self._dark_when_lost = dark_when_lost
        self._picked = 0
        self._new: tuple[int, float] = (0, 0.0)
        self._dimmed_s = float("-inf")
        self._darkened, self._there = False, False

    def verbs(
        self, levels: tuple[int, int, int] | None, state: KioskState, names: Sequence[str], now_s: float
    ) -> list[Verb]:
        """What is to be done now; call it some times a second."""
        if state.state not in _OPEN:
            self._picked, self._darkened = 0, False
            return []
        if levels is None:
            return self._lost(state)
        self._there = True
        asked: list[Verb] = []
        if self._darkened:
            self._darkened = False
            asked.append(("black", {"on": False}))
        return [*asked, *self._pick(levels, names, now_s), *self._dim(levels[1], state, now_s)]

    def _lost(self, state: KioskState) -> list[Verb]:
        if not (self._dark_when_lost and self._there) or self._darkened or state.black:
            return []
        self._darkened = True
        return [("black", {"on": True})]

    def _pick(self, levels: tuple[int, int, int], names: Sequence[str], now_s: float) -> list[Verb]:
        picked = levels[0]
        if picked != self._new[0]:
            self._new = picked, now_s
        if picked == self._picked or now_s - self._new[1] < SETTLE_S:
            return []
        self._picked = picked
        if picked == IN_TURN:
            return [("rotate", {})]
        if not 0 < picked <= len(names):
            return []
        return [("play", {"name": names[picked - 1], "fade_s": round(levels[2] * FADE_STEP_S, 1)})]

    def _dim(self, level: int, state: KioskState, now_s: float) -> list[Verb]:
        percent = round(100 * level / 255, 1)
        if abs(percent - state.brightness) < 0.2 or now_s - self._dimmed_s < DIM_EVERY_S:
            return []
        self._dimmed_s = now_s
        return [("brightness", {"percent": percent})]


STEP_S: Final = 0.05
_LOG: Final = logging.getLogger("velatura.building")


class DeskOptions(NetworkOptions):
    """``channel``: the first of the three, 1 to 510. ``lost``: whether the picture stays without a signal, or is
    black.
    """

    channel: int = Field(default=1, ge=1, le=510)
    lost: Literal["stay", "black"] = "stay"


async def follow(sources: Sources, options: DeskOptions, verbs: Verbs) -> Never:
    """Show what the source that counts asks for, until cancelled."""
    follower = Follower(dark_when_lost=options.lost == "black")
    while True:
        await asyncio.sleep(STEP_S)
        now_s = time.monotonic()
        await asyncio.to_thread(_step, follower, sources.levels(now_s), verbs, now_s)


def _step(follower: Follower, levels: tuple[int, int, int] | None, verbs: Verbs, now_s: float) -> None:
    try:
        for verb, values in follower.verbs(levels, verbs.status(), verbs.appearances(), now_s):
            verbs.do(verb, values)
    except VelaturaError:
        # A stage that is not set up, or that closes at this moment; the desk keeps sending.
        _LOG.debug("A level could not be followed.", exc_info=True)
