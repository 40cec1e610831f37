"""The USB devices of an emulated stage, on a bus of their own (``bench/usb.toml``).

They are seen by programs that run under the preload library, with the environment that ``UsbDevices`` tells; every
other program sees this machine's own USB.
"""

from __future__ import annotations

import contextlib
import ctypes
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Self

from hal.errors import DeviceError
from hal.runtime.caches import SHORTEST, temporary
from hal.runtime.files import read_text
from lab.emulated.usb.bus import PRELOAD, environment
from lab.emulated.usb.camera import STAGE_CAMERA
from lab.emulated.usb.process import KINDS, UsbBusProcess
from plugins.emulated.core.tables import Between, load
from plugins.emulated.core.truth import USB_FILE

_SETTINGS: Final[Mapping[str, tuple[str, ...]]] = {
    "relay": ("serial", "channels"),
    "light": ("serial", "lux"),
    "keys": ("serial",),
    "camera": ("serial",),
    STAGE_CAMERA: (),
}


@dataclass(frozen=True, slots=True)
class UsbDeviceTruth:
    """One device. ``kind``: relay, light, keys, camera or stage-camera.

    ``channels`` of a relay board, ``lux`` at a light sensor. The stage-camera is that of bench.toml, which looks at the
    stage, on USB instead of the network.
    """

    name: str
    kind: str
    serial: str = ""
    channels: Annotated[int, Between(1, 8)] = 2
    lux: Annotated[float, Between(0.0, 100_000.0)] = 0.5


@dataclass(frozen=True, slots=True)
class UsbTruth:
    """The tables ``[[device]]`` of the file."""

    device: tuple[UsbDeviceTruth, ...]


def read_usb(stage: Path) -> tuple[UsbDeviceTruth, ...]:
    """The USB devices of a stage; none without the file. Raises DeviceError as ``tables.load``, or "usb-kind"."""
    path = stage / USB_FILE
    if not path.exists():
        return ()
    try:
        text = read_text(path)
    except (OSError, UnicodeDecodeError) as error:
        raise DeviceError(
            "bench-file-missing", what=f"{path} can't be read.", remedy="Make it a text file, or remove it."
        ) from error
    devices = load(text, UsbTruth, file=str(path)).device
    names: set[str] = set()
    for device in devices:
        if device.kind not in _SETTINGS or device.name in names:
            raise DeviceError(
                "usb-kind",
                what=f"{path}: the device {device.name!r} occurs twice, or its kind {device.kind!r} does not exist.",
                remedy=f"Give every device a unique name and one of the kinds {', '.join(_SETTINGS)}.",
            )
        names.add(device.name)
    if sum(device.kind == STAGE_CAMERA for device in devices) > 1:
        raise DeviceError(
            "usb-kind",
            what=f"{path}: two devices are the camera that looks at the stage.",
            remedy=f"Keep only one of kind {STAGE_CAMERA}; cameras of kind camera make pictures of their own.",
        )
    return devices


class UsbDevices:
    """The bus with its devices plugged in, in a process of its own; a context.

    ``stage_camera``: what ``camera.ExposureServer.camera`` tells, for the device that is one;
    ``environment``: variables that a program needs to see them. Raises DeviceError
    ("usb-no-preload") where the preload library is missing.
    """

    def __init__(
        self,
        devices: tuple[UsbDeviceTruth, ...],
        scenario: str = "",
        *,
        stage_camera: Mapping[str, Any] | None = None,
    ) -> None:
        try:
            ctypes.CDLL(PRELOAD)
        except OSError as error:
            raise DeviceError(
                "usb-no-preload",
                what=f"Emulated USB devices need {PRELOAD}, which is not installed.",
                remedy="Install it (Debian: apt-get install libumockdev0), or remove bench/usb.toml.",
            ) from error
        self._stack = contextlib.ExitStack()
        folder = self._stack.enter_context(temporary(SHORTEST))
        self.environment = environment(folder)
        try:
            bus = self._stack.enter_context(UsbBusProcess(folder))
            self._bus = bus
            for device in devices:
                settings = (stage_camera or {}) if device.kind == STAGE_CAMERA else _settings(device)
                bus.add(device.name, device.kind, **settings)
                if scenario:
                    bus.play(device.name, scenario)
        except BaseException:
            self._stack.close()
            raise

    def moves(self, relay: str, count: int) -> list[tuple[int, bool]]:
        """What a relay board did after its first ``count`` moves, as (channel, closed)."""
        return [(channel, closed) for channel, closed in self._bus.call(relay, "moves_since", count)]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()


def _settings(device: UsbDeviceTruth) -> dict[str, Any]:
    assert device.kind in KINDS
    settings = {key: getattr(device, key) for key in _SETTINGS[device.kind]}
    return {key: value for key, value in settings.items() if value != ""}
