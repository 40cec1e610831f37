"""What a person should know: something observed, wrong or corrected, with its code and its remedy.

Drivers, steps, the doctor and the kiosk all report with this one type. Only the standard library is imported here.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass

from hal.errors import CodedError


class Level(enum.StrEnum):
    """How urgent a notice is."""

    INFO = "info"
    """Something happened; nothing is wrong."""
    WARNING = "warning"
    """Something is wrong or was corrected; the work continues."""
    ERROR = "error"
    """Something failed, or needs a person."""


@dataclass(frozen=True, slots=True)
class Notice:
    """Something that a person should know.

    Parameters
    ----------
    code : stable, lower case with hyphens, e.g. ``"camera-slow"``; "" in notices of earlier versions without one
    what : one sentence on what was observed
    remedy : one sentence on what to do; "" if nothing has to be done, or if ``what`` says it already
    level : how urgent it is
    about : the device, projector or file; "" for the whole stage, or where this is clear

    Its texts may come from a device or a file, so they are untrusted: escape them where they are shown.
    """

    code: str
    what: str
    remedy: str = ""
    level: Level = Level.INFO
    about: str = ""

    @classmethod
    def warning(cls, code: str, what: str, remedy: str = "", *, about: str = "") -> Notice:
        """A notice of the level ``WARNING``."""
        return cls(code, what, remedy, Level.WARNING, about)

    @classmethod
    def of(cls, error: CodedError, *, level: Level = Level.WARNING, about: str = "") -> Notice:
        """What an error says."""
        return cls(error.code, error.what, error.remedy, level, about)

    @property
    def text(self) -> str:
        """Both sentences."""
        return f"{self.what} {self.remedy}".strip()
