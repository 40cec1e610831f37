"""The controller's errors; their base and the errors of devices are in ``hal.errors``."""

from __future__ import annotations

from typing import ClassVar, Final

from hal.errors import CodedError

SEND_DIAGNOSTICS: Final = "Export the diagnostics and send them to the maintainers."
"""What to do about the code ``crash``: an error that the program did not expect."""


class VelaturaError(CodedError):
    """An error of the controller that a person can act on: ``code``, ``what`` and ``remedy`` as in ``CodedError``.

    ``exit_code`` is what the command line returns: 1 the work failed, 2 wrong use, 3 a device failed.
    """

    exit_code: ClassVar[int] = 1


class UsageError(VelaturaError):
    """Wrong arguments, a wrong stage.toml, a wrong file."""

    exit_code = 2


class WorkError(VelaturaError):
    """The work could not be done: no solution, no space, too little light."""


class CalibrationError(WorkError):
    """The captures do not allow a trustworthy calibration."""


class BundleError(WorkError):
    """A bundle is damaged, not trusted, or does not fit this stage."""
