"""A HID device through hidapi, with deadlines for hanging calls, and finding a lost device again."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol

from hal.codecs.ptp.values import printable
from hal.errors import DeviceGone, DeviceRefused, PluginError
from plugins.worker_link import NotOpened, WorkerLink

BACKENDS: Final = {"hidraw": "hidraw", "libusb": "hid"}
"""hidapi's modules: ``hidraw`` leaves the kernel's driver in place, ``hid`` goes round it through libusb."""
_LONGEST_NAME: Final = 126


class HidHandle(Protocol):
    """The used part of ``hid.device``. Every call raises OSError or ValueError if it fails."""

    def open_path(self, path: bytes) -> None: ...
    def close(self) -> None: ...
    def get_feature_report(self, number: int, length: int) -> list[int]: ...
    def get_input_report(self, number: int, length: int) -> list[int]: ...
    def send_feature_report(self, data: Sequence[int]) -> int: ...


@dataclass(frozen=True, slots=True)
class HidFound:
    """A device in hidapi's list; its names come from the device and are made printable."""

    path: bytes
    maker: str
    product: str
    serial: str


@dataclass(frozen=True, slots=True)
class HidKind:
    """The kind of device to find. ``name`` is for messages, e.g. "relay board".

    ``suits`` excludes other devices with the same numbers; ``serial_of`` gives the serial number of an open one.
    """

    name: str
    vendor: int
    product: int
    suits: Callable[[HidFound], bool] = lambda found: True
    serial_of: Callable[[HidHandle, HidFound], str] = lambda handle, found: found.serial


@dataclass(frozen=True, slots=True)
class OpenHid:
    """The device that is open now."""

    handle: HidHandle
    found: HidFound
    serial: str


class HidLink(WorkerLink[OpenHid]):
    """A ``WorkerLink`` to one HID device.

    ``serial``: it must have this serial number; "" uses the only one, and keeps to it.
    """

    def __init__(self, kind: HidKind, *, serial: str = "", backend: str = "hidraw") -> None:
        super().__init__(kind.name, broken=(OSError, ValueError))
        self._kind = kind
        self._serial = serial
        self._module = _hidapi(backend)

    def let_go(self, opened: OpenHid) -> None:
        opened.handle.close()

    def find(self) -> OpenHid:
        """See ``WorkerLink.find``. Raises DeviceGone, or DeviceRefused (several of them, or no permission)."""
        matching = self._matching()
        if len(matching) == 1:
            self._serial = matching[0].serial
            return matching[0]
        for device in matching:
            device.handle.close()
        if matching:
            raise DeviceRefused(
                "hid-several",
                what=f"There are {len(matching)} devices that could be the {self._kind.name}"
                f" ({', '.join(device.serial or 'no serial number' for device in matching)}).",
                remedy="Write the serial number of the right one into stage.toml, or unplug the others.",
            )
        which = f" with serial number {self._serial}" if self._serial else ""
        raise DeviceGone(
            "hid-unplugged",
            what=f"No {self._kind.name}{which} is plugged in ({self._kind.vendor:04x}:{self._kind.product:04x}).",
            remedy="Check its cable and its hub. Velatura uses it again when it is plugged in.",
        )

    def _matching(self) -> list[OpenHid]:
        opened: list[OpenHid] = []
        refused: NotOpened | None = None
        for found in self._listed():
            handle: HidHandle = self._module.device()
            try:
                handle.open_path(found.path)
                serial = self._kind.serial_of(handle, found)
            except (OSError, ValueError) as error:
                handle.close()
                if not any(other.path == found.path for other in self._listed()):
                    continue  # it was just unplugged
                refused = self.not_opened(error)
                if self._serial:
                    continue  # another one may be the right device, and work
                for device in opened:
                    self.let_go(device)
                raise refused from error
            except BaseException:
                handle.close()
                raise
            if self._serial and serial != self._serial:
                handle.close()
                continue
            opened.append(OpenHid(handle, found, serial))
        if refused is not None and not opened:
            raise refused
        return opened

    def _listed(self) -> list[HidFound]:
        """Each device once, although hidapi lists one for every usage."""
        entries = self._module.enumerate(self._kind.vendor, self._kind.product)
        by_path = {entry["path"]: entry for entry in entries}
        found = [
            HidFound(path, *(_name(entry[key]) for key in ("manufacturer_string", "product_string", "serial_number")))
            for path, entry in by_path.items()
        ]
        return [device for device in found if self._kind.suits(device)]


def _name(text: object) -> str:
    return printable(str(text or "")[:_LONGEST_NAME])


def _hidapi(backend: str) -> Any:
    if backend not in BACKENDS:
        raise PluginError(
            "setting-wrong",
            what=f"The setting 'backend' is {backend!r}.",
            remedy=f"Write one of these for backend in stage.toml: {', '.join(BACKENDS)}.",
        )
    try:
        return importlib.import_module(BACKENDS[backend])
    except ImportError as error:
        raise PluginError(
            "hidapi-missing",
            what=f"The library for HID devices could not be loaded: {error}.",
            remedy="Install the Python package hidapi (it comes with velatura[controller]).",
        ) from error
