"""The base of all errors that a person can act on, and the errors of the hardware layer.

Every error carries a stable ``code`` (for logs, tests and translation), ``what`` happened in one sentence, and the
``remedy`` in one sentence. Both sentences are for the technician, not for the programmer. The controller's errors stand
in ``controller.core.errors``. Only the standard library is imported here: the player loads this module, too.
"""

from __future__ import annotations

import functools


class CodedError(Exception):
    """An error that a person can act on: the base of ``DeviceError`` and of the controller's ``VelaturaError``.

    Parameters
    ----------
    code : stable, lower case with hyphens, e.g. ``"projector-no-answer"``
    what : one sentence on what happened
    remedy : one sentence on what to do
    """

    def __init__(self, code: str, *, what: str, remedy: str) -> None:
        super().__init__(f"{what} {remedy}")
        self.code = code
        self.what = what
        self.remedy = remedy

    def __reduce__(self) -> tuple[object, ...]:
        # By itself an error is sent to another process by its positional arguments alone.
        made = functools.partial(type(self), self.code, what=self.what, remedy=self.remedy)
        return made, (), self.__dict__


class DeviceError(CodedError):
    """A device, or the connection to it, failed."""


class DeviceGone(DeviceError):
    """The device is not on its bus (any more)."""


class DeviceBusy(DeviceError):
    """The device is busy; trying again later may work."""


class DeviceTimeout(DeviceError):
    """No answer, or no confirmation, before the deadline."""


class DeviceRefused(DeviceError):
    """The device refused the command."""


class ProtocolError(DeviceError):
    """Bytes that the protocol does not allow. ``theirs`` says whether the device or the caller broke it."""

    def __init__(self, code: str, *, what: str, remedy: str, theirs: bool = True) -> None:
        super().__init__(code, what=what, remedy=remedy)
        self.theirs = theirs


class PluginError(DeviceError):
    """A driver could not be found, loaded or configured."""


class DriverFault(DeviceError):
    """A driver broke its interface: it raised something else than ``DeviceError``, or returned a wrong object."""
