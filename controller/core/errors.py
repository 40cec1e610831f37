"""The controller's errors; the command line also handles device errors (``hal.errors``)."""

from __future__ import annotations

from typing import ClassVar, Final

SEND_DIAGNOSTICS: Final = "Export the diagnostics and send them to the maintainers."
"""What to do about the code ``crash``: an error that the program did not expect."""


class VelaturaError(Exception):
    """An error that a person can act on.

    Parameters
    ----------
    code : stable, lower case with hyphens, e.g. ``"stage-key-unknown"``
    what : one sentence on what happened
    remedy : one sentence on what to do

    ``exit_code`` is what the command line returns: 1 the work failed, 2 wrong use, 3 a device failed.
    """

    exit_code: ClassVar[int] = 1

    def __init__(self, code: str, *, what: str, remedy: str) -> None:
        super().__init__(f"{what} {remedy}")
        self.code = code
        self.what = what
        self.remedy = remedy


class UsageError(VelaturaError):
    """Wrong arguments, a wrong stage.toml, a wrong file."""

    exit_code = 2


class WorkError(VelaturaError):
    """The work could not be done: no solution, no space, too little light."""


class CalibrationError(WorkError):
    """The captures do not allow a trustworthy calibration."""


class BundleError(WorkError):
    """A bundle is damaged, not trusted, or does not fit this stage."""
