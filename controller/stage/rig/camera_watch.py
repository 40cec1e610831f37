"""Watches the camera's state: corrected faults go to the journal, warnings such as a low battery to the technician."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Final

from controller.run.runner import Context
from hal.deadline import Cancelled
from hal.errors import DeviceError
from hal.interfaces import Camera, WatchedCamera
from hal.notices import Level

EVERY_S: Final = 60.0
"""Time between two queries of the camera's battery and card."""
_ASK_S: Final = 5.0
_SAID: Final[Mapping[str, str]] = {
    "battery-low": "The camera's battery is low: connect its power supply.",
    "card-nearly-full": "The camera's card is nearly full: replace or empty it.",
    "card-unusable": "The camera can't write to its card: check the card's lock, or replace the card.",
    "autofocus-on": "The camera's lens is on autofocus: set it to manual focus, or photographs may be blurred or fail.",
    "mode-dial": "The camera's mode dial is not on M: turn it to M, or exposures may be wrong.",
    "target-changed": "The camera stored a picture at the wrong place. The setting was sent again.",
}


class CameraWatch:
    """Asks ``camera`` for corrected faults and its state, if its driver supports it; never raises for it."""

    def __init__(self, camera: Camera, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._camera = camera if isinstance(camera, WatchedCamera) else None
        self._clock = clock
        self._next_s = clock()

    def check(self, context: Context) -> None:
        """After a photograph: journal corrected faults; once a minute, ask for the camera's state."""
        if self._camera is None:
            return
        for notice in self._camera.notices():
            context.journal.record(notice.code, notice.what, Level.WARNING)
        if self._clock() < self._next_s:
            return
        self._next_s = self._clock() + EVERY_S
        try:
            status = self._camera.status(deadline=context.deadline.within(_ASK_S))
        except Cancelled:
            raise
        except DeviceError as error:
            # The next photograph will show whether the camera is gone; a failed query alone must not fail the run.
            context.journal.record(error.code, error.what, Level.WARNING)
            return
        known = {event.code for event in context.journal.events()} if status.warnings else set()
        for warning in status.warnings:
            if f"camera-{warning}" not in known:
                sentence = _SAID.get(warning, f"The camera warns: {warning}.")
                context.journal.record(f"camera-{warning}", sentence, Level.WARNING)
                context.reporter.say(sentence, Level.WARNING)
