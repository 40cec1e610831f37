"""The worker of a ``plugins.library_process`` that keeps one device open."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from typing import Any, Generic, Protocol, TypeVar

from hal.errors import DeviceError, DeviceGone, DeviceTimeout
from plugins.library_process import Answer, Failed


class Closable(Protocol):
    """What a library opens."""

    def close(self) -> None: ...


Device = TypeVar("Device", bound=Closable)


class DeviceWorker(ABC, Generic[Device]):
    """Its public methods are the requests. The device is opened at the first of them, and again when it was lost.

    ``_serial``: the serial number that the device must have, "" for any
    """

    def __init__(self, serial: str) -> None:
        self._serial = serial
        self._device: Device | None = None

    @abstractmethod
    def _open_device(self) -> Device:
        """The device, just opened."""

    def _prepare(self, device: Device) -> None:
        """Make an opened device ready for requests; it is closed if this raises."""

    def _do(self, name: str, arguments: tuple[Any, ...]) -> Any:
        """The result of a request. Raises DeviceError: a library's own errors are translated here."""
        return getattr(self, name)(*arguments)

    def answer(self, name: str, arguments: tuple[Any, ...]) -> Answer:
        """Do a request. A lost device is closed, so that the next request opens it again."""
        began_s = time.monotonic()
        try:
            result = self._do(name, arguments)
        except DeviceError as error:
            lost = isinstance(error, DeviceGone | DeviceTimeout) and self._device is not None
            if lost:
                self.close()
            return Failed.of(error, lost=lost)
        return result, self._serial, time.monotonic() - began_s

    def close(self) -> None:
        device, self._device = self._device, None
        if device is not None:
            device.close()

    def _open(self) -> Device:
        if self._device is None:
            device = self._open_device()
            try:
                self._prepare(device)
            except BaseException:
                device.close()
                raise
            self._device = device
        return self._device
