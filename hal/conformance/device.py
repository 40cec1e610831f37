"""Tests for every kind of device."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, ClassVar

import pytest

from hal.deadline import Cancelled, Deadline, in_seconds
from hal.driver_calls import Caller
from hal.errors import DeviceError, DeviceTimeout, DriverFault
from hal.interfaces import Device


class DeviceConformance:
    """Tests for every kind of device; subclasses add those of their kind."""

    patience_s: ClassVar[float] = 30.0
    """Deadline of an ordinary call."""
    prompt_s: ClassVar[float] = 6.0
    """A call must end within this time after its deadline or cancellation."""

    def soon(self) -> Deadline:
        return in_seconds(self.patience_s)

    def check_identity(self, device: Device) -> None:
        who = device.identity(deadline=self.soon())
        assert who.model.strip(), "the device must report its model"

    def check_closes_twice(self, device: Device) -> None:
        for _ in range(2):
            started = time.monotonic()
            device.close()
            assert time.monotonic() - started < self.prompt_s, "close() must not block"
        with pytest.raises(DeviceError):
            device.identity(deadline=self.soon())

    def check_types(self, kind: str, device: Device, *calls: Callable[[Any], object]) -> None:
        """Each call returns what ``hal.interfaces`` says, and raises a ``DeviceError`` once the device is closed.

        A driver that raises or returns anything else is stopped by the controller (``hal.driver_calls``), which then
        can only say that it is broken.
        """
        checked = Caller("The driver under test").device(kind, device)
        calls = (lambda it: it.identity(deadline=self.soon()), *calls)
        for call in calls:
            call(checked)
        checked.close()
        for call in calls:
            with pytest.raises(DeviceError) as caught:
                call(checked)
            assert not isinstance(caught.value, DriverFault), caught.value

    def check_deadline_and_cancel(self, device: Device) -> None:
        started = time.monotonic()
        with pytest.raises(DeviceTimeout) as caught:
            device.identity(deadline=in_seconds(-1.0))
        assert caught.value.what
        assert caught.value.remedy
        stop = threading.Event()
        stop.set()
        with pytest.raises(Cancelled):
            device.identity(deadline=in_seconds(self.patience_s, stop))
        assert time.monotonic() - started < self.prompt_s
        self.check_identity(device)
