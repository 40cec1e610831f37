"""Opens the technician's key panel as soon as it is connected, and reports its problems."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from contextlib import AbstractContextManager

from controller.kiosk.state import DeviceRow
from controller.run.state_machine import State
from hal.errors import CodedError
from hal.interfaces import ButtonPanel
from hal.notices import Level, Notice


class KeysSupervisor:
    """One key panel. One thread calls ``step`` repeatedly until it is open; then ``KeyService`` takes over.

    ``open_panel`` opens the panel, and closes it at the end; ``presses``: the actions of play, stop and recalibrate.
    """

    def __init__(
        self, driver: str, open_panel: Callable[[], AbstractContextManager[ButtonPanel]],
        presses: tuple[Callable[[], None], Callable[[], None], Callable[[], None]], state: Callable[[], State],
        tell: Callable[[Notice], object],
    ) -> None:  # fmt: skip
        self.driver = driver
        self._open, self._presses, self._state, self._tell = open_panel, presses, state, tell
        self._opened: contextlib.ExitStack | None = None
        self._problem: Notice | None = None
        self._closed = False

    @property
    def row(self) -> DeviceRow:
        """The row that the web panel shows."""
        what, remedy = (None, "") if self._problem is None else (self._problem.what, self._problem.remedy)
        return DeviceRow("key panel", "keys", self.driver, (), what, remedy)

    def step(self) -> None:
        """Open the panel if it is not open yet."""
        if self._opened is not None:
            return
        # Imported late: it loads OpenCV, which would delay the first picture after a boot.
        from controller.stage.rig.key_panel import KeyService, technicians_keys

        with contextlib.ExitStack() as stack:
            try:
                panel = stack.enter_context(self._open())
            except CodedError as error:
                self._trouble(error)
                return
            commands = technicians_keys(*self._presses)
            service = KeyService(panel, commands, state=self._state, trouble=self._trouble)
            # Before the start, so that a problem of the service itself is not cleared here.
            self._trouble(None)
            service.start()
            stack.callback(service.stop)
            self._opened = stack.pop_all()
        if self._closed:
            # Closed while it was being opened: release it, because the next service needs it.
            self._release()

    def close(self) -> None:
        """Close the panel for good."""
        self._closed = True
        self._release()

    def _release(self) -> None:
        opened, self._opened = self._opened, None
        if opened is not None:
            opened.close()

    def _trouble(self, error: CodedError | None) -> None:
        before, self._problem = self._problem, None
        if error is not None:
            self._problem = Notice(error.code, error.what, error.remedy, Level.WARNING)
            if before is None or before.code != error.code:
                self._tell(self._problem)
        elif before is not None:
            self._tell(Notice("keys-back", "The technician's keys work again."))
