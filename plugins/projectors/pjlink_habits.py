"""Special behaviour of one PJLink projector, learned since it was opened, and how soon it may be asked."""

from __future__ import annotations

import time
from typing import Final

from hal.codecs.projectors.profiles import Timing
from hal.deadline import Deadline
from plugins.projectors.optional_answers import OptionalAnswers

_FIELDS: Final = {
    "INST": "inputs",
    "LAMP": "lamp hours",
    "ERST": "faults",
    "CLSS": "extras of PJLink class 2",
    "INF1": "maker",
    "INF2": "model",
    "INFO": "firmware",
    "SVER": "firmware",
    "SNUM": "serial number",
}


class Habits(OptionalAnswers):
    """For one projector. ``name``: its name for the technician, for notes.

    ``slow``: it starts, cools, or did not answer, so the next query has to wait: users report projectors that hang
    when asked often while they start. ``closes``: it closes the connection after each answer. ``second_level``: it
    checks the password by SHA-256; None until MD5 was refused. ``mute``: the kind of AVMT that it accepts.
    """

    def __init__(self, name: str, timing: Timing) -> None:
        self.slow = True
        self.closes = False
        self.second_level: bool | None = None
        self.mute = "1"
        super().__init__(name, _FIELDS)
        self._timing = timing
        self._asked_at_s = -1e9

    def wait(self, deadline: Deadline) -> None:
        """Wait until the next query may be sent."""
        interval_s = self._timing.boot_interval_s if self.slow else self._timing.interval_s
        while (wait_s := self._asked_at_s + interval_s - time.monotonic()) > 0 and not deadline.passed:
            deadline.sleep(wait_s)
        self._asked_at_s = time.monotonic()
