"""Keeps the technician's keys in use: opens the panel as soon as it is there, and says what is wrong with it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from contextlib import AbstractContextManager

from controller.core.errors import VelaturaError
from controller.kiosk.interface import DeviceRow
from controller.kiosk.store.event_log import Decision
from controller.run.state_machine import State
from hal.errors import DeviceError
from hal.interfaces import ButtonPanel


class KeysKeeper:
    """One panel. ``step`` is called over and over by one thread until it is open; ``KeyService`` keeps it from then on.

    ``open_panel`` gives the panel, and closes it at the end; ``presses``: what the keys play, stop and recalibrate do.
    """

    def __init__(
        self, driver: str, open_panel: Callable[[], AbstractContextManager[ButtonPanel]],
        presses: tuple[Callable[[], None], Callable[[], None], Callable[[], None]], state: Callable[[], State],
        tell: Callable[[Decision], object],
    ) -> None:  # fmt: skip
        self.driver = driver
        self._open, self._presses, self._state, self._tell = open_panel, presses, state, tell
        self._opened: contextlib.ExitStack | None = None
        self._problem: Decision | None = None
        self._closed = False

    @property
    def row(self) -> DeviceRow:
        """As the panel shows it."""
        what, remedy = (None, "") if self._problem is None else (self._problem.reason, self._problem.remedy)
        return DeviceRow("key panel", "keys", self.driver, (), what, remedy)

    def step(self) -> None:
        """Look for the panel, unless it was found."""
        if self._opened is not None:
            return
        # Here: it draws its keys with OpenCV, for which the first picture of a boot must not wait.
        from controller.rig.key_panel import KeyService, technicians_keys

        with contextlib.ExitStack() as stack:
            try:
                panel = stack.enter_context(self._open())
            except (DeviceError, VelaturaError) as error:
                self._trouble(error)
                return
            commands = technicians_keys(*self._presses)
            service = KeyService(panel, commands, state=self._state, trouble=self._trouble)
            # Before it starts: the trouble that it meets is told once, and must not be taken back here.
            self._trouble(None)
            service.start()
            stack.callback(service.stop)
            self._opened = stack.pop_all()
        if self._closed:
            # While it was opened: nobody else would ever let go of it, and the next service needs it.
            self._let_go()

    def close(self) -> None:
        """Let go of the panel, for good."""
        self._closed = True
        self._let_go()

    def _let_go(self) -> None:
        opened, self._opened = self._opened, None
        if opened is not None:
            opened.close()

    def _trouble(self, error: DeviceError | VelaturaError | None) -> None:
        before, self._problem = self._problem, None
        if error is not None:
            self._problem = Decision(error.code, error.what, error.remedy, "warning")
            if before is None or before.code != error.code:
                self._tell(self._problem)
        elif before is not None:
            self._tell(Decision("keys-back", "The technician's keys work again."))
