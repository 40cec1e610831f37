"""Keeps a device open, polls it (camera, light sensor, relays), and reopens it when it is lost."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final

from controller.kiosk.state import DeviceRow, LiveValue
from controller.kiosk.world import Lock, World
from hal.deadline import Deadline
from hal.errors import CodedError, DeviceError
from hal.interfaces import Device
from hal.notices import Level, Notice

LONGEST_S: Final = 15.0
"""Not longer, because a person who plugs a cable in again waits for the result."""
_SHORTEST_S: Final = 2.0
_SHARE: Final = 0.25


def pause_s(missing_s: float) -> float:
    """Seconds until the next attempt, for a device that has been missing for ``missing_s``.

    A share of that time: what is back after half a minute, as a projector that boots, is not waited for much longer.
    """
    return min(LONGEST_S, max(_SHORTEST_S, _SHARE * missing_s))


OPEN_S: Final = 20.0
LOOK_S: Final = 10.0

Look = Callable[[Device, Deadline], tuple[LiveValue, ...]]


class DeviceSupervisor:
    """One device. One thread calls ``step`` repeatedly.

    ``row``: its name, kind and driver; ``look`` polls the device and returns the values to show; ``every_s``: seconds
    between two polls. ``lent`` is held while a job has the device for itself.
    """

    def __init__(
        self, row: DeviceRow, open_it: Callable[[Deadline], Device], look: Look, tell: Callable[[Notice], object],
        *, every_s: float = 30.0, world: World | None = None,
    ) -> None:  # fmt: skip
        world = world or World()
        self.name, self._row = row.name, row
        self._open, self._look, self._tell = open_it, look, tell
        self._every_s, self._monotonic, self._deadline = every_s, world.monotonic, world.deadline
        self._device: Device | None = None
        self._problem: Notice | None = None
        self._next_s = 0.0
        self._lost_since_s: float | None = None
        self._closed = False
        self.lent: Lock = world.lock()

    @property
    def device(self) -> Device | None:
        """The opened device; None while it is missing."""
        return self._device

    @property
    def problem(self) -> Notice | None:
        return self._problem

    @property
    def row(self) -> DeviceRow:
        what, remedy = (None, "") if self._problem is None else (self._problem.what, self._problem.remedy)
        return replace(self._row, problem=what, remedy=remedy)

    def step(self) -> None:
        """Poll the device if it is time to, except while it is lent to a job."""
        if self._monotonic() < self._next_s or not self.lent.acquire(blocking=False):
            return
        try:
            if self._device is None:
                self._device = self._open(self._deadline(OPEN_S))
            values = self._look(self._device, self._deadline(LOOK_S))
            self._row = replace(self._row, values=values)
            self._recovered()
        except CodedError as error:
            self._lost(Notice(error.code, error.what, error.remedy, Level.ERROR))
        finally:
            if self._closed:
                # Closed while it was being opened: release it, because the next service needs it.
                self._release()
            self.lent.release()

    def close(self) -> None:
        """Close the device for good."""
        self._closed = True
        self._release()

    def _release(self) -> None:
        device, self._device = self._device, None
        if device is not None:
            try:
                device.close()
            except DeviceError as error:
                self._tell(Notice(error.code, error.what, error.remedy, Level.WARNING))

    def _recovered(self) -> None:
        if self._problem is not None:
            self._tell(Notice("device-back", f"{self.name} is connected again."))
        self._problem = self._lost_since_s = None
        self._next_s = self._monotonic() + self._every_s

    def _lost(self, problem: Notice) -> None:
        self._release()
        self._row = replace(self._row, values=())
        now_s = self._monotonic()
        if self._lost_since_s is None:
            self._lost_since_s = now_s
        self._next_s = now_s + pause_s(now_s - self._lost_since_s)
        if self._problem is None or self._problem.code != problem.code:
            self._tell(problem)
        self._problem = problem
