"""A projector with a douser before its lens: open while its lamp burns because somebody wants light, else closed."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Final

from hal.deadline import Cancelled, Deadline
from hal.errors import DeviceError
from hal.interfaces import AdjustedProjector, Douser, Projector, WatchedProjector
from hal.notices import Notice
from hal.values import DeviceIdentity, Power, ProjectorCapabilities, ProjectorStatus

MOVE_S: Final = 25.0
"""Longest that one movement may take."""


class ProjectorWithDouser:
    """``hal.interfaces.WatchedProjector`` and ``AdjustedProjector``; its shutter is the douser.

    The douser follows every status and every switch. When it fails, the lamp can still be read and switched off: the
    error is one of ``notices``, and only ``switch_on`` and ``set_shutter`` raise it.

    Parameters
    ----------
    name : the projector's, for messages
    open_douser : opens it, when it is first needed and again after a failure; raises DeviceError
    """

    def __init__(self, name: str, projector: Projector, open_douser: Callable[[Deadline], Douser]) -> None:
        self._name = name
        self._projector = projector
        self._open_douser = open_douser
        self._opening = threading.Lock()
        self._douser: Douser | None = None
        self._passes: bool | None = None
        self._wanted_off = False
        self._failed = ""
        self._own_notices: list[Notice] = []

    @property
    def capabilities(self) -> ProjectorCapabilities:
        return replace(self._projector.capabilities, shutter=True)

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        return self._projector.identity(deadline=deadline)

    def status(self, *, deadline: Deadline) -> ProjectorStatus:
        """The projector's; the douser follows it. Raises only what the projector raises, and Cancelled."""
        status = self._projector.status(deadline=deadline)
        if status.power in (Power.OFF, Power.COOLING):
            self._wanted_off = False
        self._follow(self._light_wanted(status.power), deadline)
        return status

    def switch_on(self, *, deadline: Deadline) -> None:
        """Open the douser, then strike. No lamp is struck whose douser can't be commanded."""
        self._move(False, deadline)
        self._passes, self._wanted_off = True, False
        self._projector.switch_on(deadline=deadline)

    def switch_off(self, *, deadline: Deadline) -> None:
        """Switch off, and close the douser in every case."""
        self._wanted_off = True
        try:
            self._projector.switch_off(deadline=deadline)
        finally:
            self._follow(False, deadline)

    def set_shutter(self, closed: bool, *, deadline: Deadline) -> None:
        self._move(closed, deadline)

    def notices(self) -> list[Notice]:
        own, self._own_notices = self._own_notices, []
        return [*(self._projector.notices() if isinstance(self._projector, WatchedProjector) else []), *own]

    def adjustments(self, *, deadline: Deadline) -> dict[str, str]:
        projector = self._projector
        return projector.adjustments(deadline=deadline) if isinstance(projector, AdjustedProjector) else {}

    def close(self) -> None:
        """Lamp and light stay as they are, as far as the douser's own hardware allows."""
        with contextlib.ExitStack() as stack:
            stack.callback(self._projector.close)
            if self._douser is not None:
                stack.callback(self._douser.close)

    def _light_wanted(self, power: Power) -> bool | None:
        """Whether light is to pass; None: as it is."""
        if power in (Power.OFF, Power.COOLING):
            return False
        if power in (Power.ON, Power.WARMING):
            return not self._wanted_off
        if power is Power.UNKNOWN and self._passes is None and not self._projector.capabilities.power:
            return True  # only a person knows whether it is lit
        return self._passes

    def _follow(self, passes: bool | None, deadline: Deadline) -> None:
        if passes is None:
            return
        try:
            if passes is not self._passes:
                self._move(not passes, deadline)
                self._passes = passes
            else:
                self._opened(deadline).closed(deadline=deadline)
        except Cancelled:
            raise
        except DeviceError as error:
            if error.code != self._failed:
                what = f"The douser of projector {self._name} fails: {error.what}"
                self._own_notices.append(Notice.warning(error.code, what))
            self._failed = error.code
        else:
            self._failed = ""

    def _move(self, closed: bool, deadline: Deadline) -> None:
        self._opened(deadline).move(closed, deadline=deadline.within(MOVE_S))

    def _opened(self, deadline: Deadline) -> Douser:
        with self._opening:
            if self._douser is None:
                self._douser = self._open_douser(deadline)
            return self._douser
