"""Calls of a library that may hang, with deadlines: they run on a thread of their own (``CallThread``), which opens the
device, and closes it when it ends."""

from __future__ import annotations

import contextlib
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Final, Generic, TypeVar

from hal.deadline import SLICE_S, Deadline
from hal.errors import DeviceError, DeviceGone, DeviceRefused, ProtocolError
from hal.runtime.call_threads import CallThread

Opened = TypeVar("Opened")
Result = TypeVar("Result")

_CLOSE_S: Final = 0.7
_LISTED_S: Final = 2.0
"""Time limit for a listed device that can't be opened: it was just unplugged, or udev has not applied its rules yet."""


class NotOpened(DeviceRefused):
    """The device is listed, but cannot be opened."""


class WorkerLink(ABC, Generic[Opened]):
    """The connection to one device: opened when needed, and again after it was lost. One caller at a time.

    ``name``: of the device, for sentences, e.g. "relay board"; ``broken``: what the library raises when the way to the
    device breaks.
    """

    def __init__(self, name: str, *, broken: tuple[type[Exception], ...]) -> None:
        self._name = name
        self._broken = broken
        self._opened: Opened | None = None
        self._thread = CallThread("hid", check=self._still_time, closed=self._was_closed, at_end=self._drop)

    @abstractmethod
    def find(self) -> Opened:
        """Find and open the device; on the worker's thread. Raises DeviceError or ``broken``; nothing is open then.

        After ``NotOpened`` it is called again for a while.
        """

    @abstractmethod
    def let_go(self, opened: Opened) -> None:
        """Close the device; on the worker's thread. Raises nothing."""

    def call(self, work: Callable[[Opened], Result], *, deadline: Deadline) -> Result:
        """Do ``work`` with the open device; again if the connection had broken, so it must be repeatable.

        Raises what ``find`` and ``work`` raise, DeviceGone for one that was closed, DeviceTimeout, ProtocolError where
        the device is there and fails the transfer, or Cancelled.
        """
        return self._thread.run(partial(self._try, work), deadline)

    def close(self) -> None:
        """Close the device; a hanging call is left behind after 0.7 s."""
        self._thread.close(_CLOSE_S)

    def _drop(self) -> None:
        """Close the device. On the thread of the calls."""
        opened, self._opened = self._opened, None
        if opened is not None:
            self.let_go(opened)

    def _try(self, work: Callable[[Opened], Result], deadline: Deadline) -> Result:
        for again in (False, True):
            try:
                if self._opened is None:
                    self._opened = self._find_device(deadline)
                deadline.sleep(0.0)  # the caller has given up: a relay must not move minutes later
                return work(self._opened)
            except self._broken as error:
                self._drop()
                if again:
                    self._check_there(deadline)
                    raise self._failed(error) from error
            except ProtocolError:
                self._drop()
                raise
        raise AssertionError

    def _find_device(self, deadline: Deadline) -> Opened:
        """``find``, but what cannot be opened is given half of the time, at most 2 s, to leave the list or to open."""
        listed = deadline.within(min(_LISTED_S, deadline.left_s() / 2))
        while True:
            try:
                return self.find()
            except NotOpened:
                if listed.passed:
                    raise
                listed.sleep(SLICE_S)

    def _check_there(self, deadline: Deadline) -> None:
        """Raises DeviceGone if the device was unplugged during the second attempt."""
        with contextlib.suppress(*self._broken):
            try:
                self._opened = self._find_device(deadline)
            except DeviceError as error:
                if isinstance(error, DeviceGone):
                    raise

    def _was_closed(self) -> DeviceGone:
        return DeviceGone("hid-closed", what=f"The {self._name} was closed.", remedy=f"Open the {self._name} again.")

    def _still_time(self, deadline: Deadline) -> None:
        deadline.check(
            "hid-no-answer",
            what=f"The {self._name} did not answer in time.",
            remedy="Unplug it and plug it in again. If this happens often, use another cable or hub.",
        )

    def not_opened(self, error: Exception) -> NotOpened:
        """For ``find``: the device is listed, and opening it raised ``error``."""
        return NotOpened(
            "hid-not-opened",
            what=f"The {self._name} is plugged in, but can't be opened ({error}).",
            remedy="Unplug it and plug it in again. If that does not help, end other programs that use it, and install"
            " firmware_configs/udev/70-velatura-hid.rules.",
        )

    def _failed(self, error: Exception) -> ProtocolError:
        return ProtocolError(
            "hid-transfer",
            what=f"The {self._name} is plugged in, but refuses commands ({error}).",
            remedy="Unplug it and plug it in again. If this happens again, replace it.",
        )
