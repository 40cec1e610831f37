"""One display for several cameras: a picture is shown once for all views that ask for it."""

from __future__ import annotations

import contextlib
import hashlib
import threading
import time
from collections.abc import Iterator, Mapping
from typing import Final

import numpy as np

from controller.core.arrays import ByteImage
from hal.deadline import SLICE_S, Deadline
from hal.interfaces import Display
from hal.values import Presented

SHOW_S: Final = 10.0
"""Longest time in which the display presents a picture."""
PATIENCE_S: Final = 30.0
"""So long the others wait for a view that calculates. Later, they continue, and the pictures are shown again for it."""
_JOINED: Final = -(10**9)
"""Numbers of pictures that several views share begin here, so that they never follow one of the display's own."""


class SharedDisplay:
    """Lends ``display`` to the views of several cameras, each in a thread of its own.

    While two or more have joined, the picture changes only when no camera photographs it any more, and no view waits
    for it. If the views then want different ones, that comes first which was shown before: another view is ahead. Else
    they take turns.
    """

    def __init__(self, display: Display) -> None:
        self.display = display
        self.changed = threading.Condition()
        self.seats: list[Seat] = []
        self._shown = ""
        self._presented = Presented(0, 0.0)
        self._known: set[str] = set()
        self.changes = 0
        self._changed_by: Seat | None = None
        self.alone: Seat | None = None
        """The only view that may change the picture, if there is one."""

    def seat(self) -> Seat:
        """A place for one more camera; its ``show`` is the display's own until it joins."""
        return Seat(self)

    def shows(self, seat: Seat) -> Presented | None:
        """When the picture that ``seat`` wants was presented; None while it is not shown, or another view has the
        display alone. For a caller that holds ``changed``.
        """
        return self._presented if seat.wanted == self._shown and self.alone in (None, seat) else None

    def is_turn_of(self, seat: Seat) -> bool:
        """Whether ``seat`` may change the picture. For a caller that holds ``changed``."""
        if self.alone is not None:
            return self.alone is seat and not any(one.photographs for one in self.seats if one is not seat)
        waiting = [one for one in self.seats if one.wanted]
        if any(one.wanted == self._shown for one in waiting):
            return False
        if any(not one.wanted and not one.may_be_left for one in self.seats if one is not seat):
            return False
        return min(waiting, key=lambda one: (one.wanted not in self._known, one is self._changed_by)) is seat

    def forget(self) -> None:
        """What is shown is not known, because it is changed without ``change``."""
        self._shown = ""

    def change(self, seat: Seat, frames: Mapping[str, ByteImage], deadline: Deadline) -> Presented:
        """Show a picture. For a caller that holds ``changed``."""
        self._shown = ""
        self._presented = self.display.show(frames, deadline=deadline.within(SHOW_S))
        self._shown, self._changed_by = seat.wanted, seat
        self._known.add(seat.wanted)
        self.changes += 1
        return self._presented


class Seat:
    """One camera's part of a shared display. ``show`` may be called by one thread at a time."""

    def __init__(self, shared: SharedDisplay) -> None:
        self._shared = shared
        self.wanted = ""
        """Identifies the picture that this view waits for; "" while it waits for none."""
        self.photographs = False
        self._idle_since_s = 0.0
        self._number, self._seen = _JOINED, -2

    @property
    def joined(self) -> bool:
        return self in self._shared.seats

    @property
    def may_be_left(self) -> bool:
        """Whether others need not wait for this view: it photographs nothing and has calculated for long."""
        return not self.photographs and time.monotonic() > self._idle_since_s + PATIENCE_S

    def join(self) -> None:
        """From now on, pictures are shared with those that have joined."""
        with self._shared.changed:
            self.photographs, self._idle_since_s = False, time.monotonic()
            self._shared.seats.append(self)

    def leave(self) -> None:
        """No other view waits for this one any more. Harmless if it has left."""
        with self._shared.changed:
            if self in self._shared.seats:
                self._shared.seats.remove(self)
            self._shared.changed.notify_all()

    @contextlib.contextmanager
    def only(self, deadline: Deadline) -> Iterator[None]:
        """Inside, no other view changes the picture: for what is measured by its changes."""
        with self._shared.changed:
            while self._shared.alone is not None:
                self._check(deadline)
                self._shared.changed.wait(SLICE_S)
            self._shared.alone = self
        try:
            yield
        finally:
            with self._shared.changed:
                self._shared.alone = None
                self._shared.changed.notify_all()

    @staticmethod
    def _check(deadline: Deadline) -> None:
        what, remedy = "The other cameras kept the picture for too long.", "Check that all answer, then start again."
        deadline.check("views-too-slow", what=what, remedy=remedy)

    def done(self) -> None:
        """The photograph is taken: the picture may change."""
        with self._shared.changed:
            self.photographs, self._idle_since_s = False, time.monotonic()
            self._shared.changed.notify_all()

    def show(self, frames: Mapping[str, ByteImage], *, deadline: Deadline) -> Presented:
        """As ``Display.show``, once the others agree; until ``done``, the picture stays.

        The number of a picture follows that of the view's last one where the display showed nothing else between them.
        Raises Cancelled, and what the display raises.
        """
        if not self.joined:
            self._shared.forget()
            return self._shared.display.show(frames, deadline=deadline.within(SHOW_S))
        wanted, shared = frames_digest(frames), self._shared
        with shared.changed:
            self.wanted, self.photographs = wanted, False
            shared.changed.notify_all()
            try:
                while (presented := shared.shows(self)) is None:
                    if shared.is_turn_of(self):
                        presented = shared.change(self, frames, deadline)
                        break
                    self._check(deadline)
                    shared.changed.wait(SLICE_S)
                self.photographs = True
            finally:
                self.wanted = ""
                shared.changed.notify_all()
            self._number += 1 if shared.changes - self._seen <= 1 else 2
            self._seen = shared.changes
            return Presented(self._number, presented.at_s)


def frames_digest(frames: Mapping[str, ByteImage]) -> str:
    """Identifies 8-bit frames by output or projector name, for the journal; hexadecimal."""
    digest = hashlib.sha256()
    for output in sorted(frames):
        digest.update(f"{output} {frames[output].shape} ".encode())
        digest.update(np.ascontiguousarray(frames[output]).tobytes())
    return digest.hexdigest()
