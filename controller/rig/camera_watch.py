"""What the camera tells beside its pictures: mended faults go into the journal, low batteries to the technician."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Final

from controller.run.progress import Level
from controller.run.runner import Context
from hal.deadline import Cancelled
from hal.errors import DeviceError
from hal.interfaces import Camera, WatchedCamera

EVERY_S: Final = 60.0
"""Between two questions for the camera's battery and card; each takes a few of its answers."""
_ASK_S: Final = 5.0
_SAID: Final[Mapping[str, str]] = {
    "battery-low": "The camera's battery is low; give it mains power.",
    "card-nearly-full": "The camera's card is nearly full.",
    "card-unusable": "The camera's card can not be written; check its lock, or put another in.",
    "autofocus-on": "The camera's lens is on autofocus; set it to manual, or photographs may be out of focus or fail.",
    "mode-dial": "The camera's mode dial is not on M; exposures may not be what was asked for.",
    "target-changed": "The camera sent a picture elsewhere than it was told to, and was told again.",
}


class CameraWatch:
    """Asks ``camera`` what went wrong and how long it can go on, where its driver can tell; never fails for it."""

    def __init__(self, camera: Camera, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._camera = camera if isinstance(camera, WatchedCamera) else None
        self._clock = clock
        self._next_s = clock()

    def look(self, context: Context) -> None:
        """After a photograph: journal what was mended; once a minute, ask for the camera's state."""
        if self._camera is None:
            return
        for code, sentence in self._camera.troubles():
            context.journal.record(code, sentence, Level.WARNING)
        if self._clock() < self._next_s:
            return
        self._next_s = self._clock() + EVERY_S
        try:
            status = self._camera.status(deadline=context.deadline.within(_ASK_S))
        except Cancelled:
            raise
        except DeviceError as error:
            # The next photograph will tell whether the camera is gone; its state alone is not worth a failed run.
            context.journal.record(error.code, error.what, Level.WARNING)
            return
        known = {event.code for event in context.journal.events()} if status.warnings else set()
        for warning in status.warnings:
            if f"camera-{warning}" not in known:
                sentence = _SAID.get(warning, f"The camera warns: {warning}.")
                context.journal.record(f"camera-{warning}", sentence, Level.WARNING)
                context.reporter.say(sentence, Level.WARNING)
