"""The USB devices of an emulated stage, on a bus of their own (``bench/usb.toml``).

They are seen by programs that run under the preload library, with the environment that ``UsbDevices`` tells; every
other program sees this machine's own USB.
"""

from __future__ import annotations

import contextlib
import ctypes
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Self

from hal.errors import DeviceError
from plugins.emulated.tables import Between, load
from plugins.emulated.truth import FOLDER
from plugins.emulated.usb_bus import PRELOAD, environment
from plugins.emulated.usb_bus_process import KINDS, UsbBusProcess
from plugins.emulated.usb_stage_camera import STAGE_CAMERA

FILE: Final = f"{FOLDER}/usb.toml"
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
    path = stage / FILE
    if not path.exists():
        return ()
    devices = load(path.read_text(encoding="utf-8"), UsbTruth, file=str(path)).device
    names: set[str] = set()
    for device in devices:
        if device.kind not in _SETTINGS or device.name in names:
            raise DeviceError(
                "usb-kind",
                what=f"{path}: the device {device.name!r} is there twice, or its kind {device.kind!r} does not exist.",
                remedy=f"Give every device a name of its own, and one of the kinds {', '.join(_SETTINGS)}.",
            )
        names.add(device.name)
    if sum(device.kind == STAGE_CAMERA for device in devices) > 1:
        raise DeviceError(
            "usb-kind",
            what=f"{path}: two devices are the camera that looks at the stage.",
            remedy=f"Leave one of kind {STAGE_CAMERA}; others of kind camera make pictures of their own.",
        )
    return devices


class UsbDevices:
    """The bus with its devices plugged in, in a process of its own; a context.

    ``stage_camera``: what ``usb_stage_camera.Exposures.camera`` tells, for the device that is one;
    ``environment``: what a program's environment must have besides, so that it sees them. Raises DeviceError
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
        # Short, because a unix socket's path is.
        folder = Path(tempfile.mkdtemp(prefix="usb", dir="/tmp"))
        self._stack.callback(shutil.rmtree, folder, ignore_errors=True)
        self.environment = environment(folder)
        try:
            bus = self._stack.enter_context(UsbBusProcess(folder))
            self._bus = bus
            for device in devices:
                told = (stage_camera or {}) if device.kind == STAGE_CAMERA else _settings(device)
                bus.add(device.name, device.kind, **told)
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
    told = {key: getattr(device, key) for key in _SETTINGS[device.kind]}
    return {key: value for key, value in told.items() if value != ""}
