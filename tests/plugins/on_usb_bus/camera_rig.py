"""Our driver on an emulated camera on the emulated USB bus, and what its pictures must be."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from hal.deadline import in_seconds
from lab.emulated.usb.camera import numbered_files
from lab.emulated.usb.process import UsbBusProcess
from plugins.emulated.core.shot import ShotSettings
from plugins.ptp.still import PtpCamera
from plugins.ptp.usb.bus import UsbAddress, UsbFinder
from tests.plugins.ptp.ptp_rig import FLAVOURS, PATIENT, SHORT

SIZE = 300_000
NAMES = ("camera", "other", "relay", "a", "b")
"""Of the devices in these tests."""


@pytest.fixture(scope="module")
def lasting_bus() -> Iterator[UsbBusProcess]:
    """One process for a whole module: starting one takes longer than most tests."""
    with UsbBusProcess(Path(os.environ["UMOCKDEV_DIR"])) as bus:
        yield bus


@pytest.fixture
def bus(lasting_bus: UsbBusProcess) -> Iterator[UsbBusProcess]:
    """An emulated USB bus without devices, which this very process sees."""
    yield lasting_bus
    for name in NAMES:
        with contextlib.suppress(RuntimeError):
            lasting_bus.forget(name)


@dataclass
class Rig:
    bus: UsbBusProcess
    driver: PtpCamera

    def capture(self, folder: Path, name: str = "shot", *, seconds: float = 60.0) -> bytes:
        files = self.driver.capture(folder / name, deadline=in_seconds(seconds))
        assert len(files) == 1
        return files[0].path.read_bytes()

    def exposures(self) -> int:
        return int(self.bus.get("camera", "body.exposures"))

    def latest(self) -> bytes:
        """The bytes of the last JPEG that was exposed."""
        return numbered_files(self.exposures(), SIZE, ShotSettings(1, 1, 1, raw=False, jpeg=True)).jpeg or b""

    def fault(self, knob: str, value: object) -> None:
        """``camera_faults.X`` or ``pipe_faults.X``."""
        self.bus.set("camera", knob, value)


@contextmanager
def running(bus: UsbBusProcess, flavour: str, *, address: str = "usb:", **options: Any) -> Iterator[Rig]:
    camera = options.pop("camera", {})
    bus.add("camera", "camera", flavour=flavour, size=SIZE, time_scale=0.2, **camera)
    finder = UsbFinder(UsbAddress.parse(address))
    driver = PtpCamera(finder.connect, deadline=in_seconds(60), **{"timing": PATIENT, **options})
    driver.configure(SHORT, deadline=in_seconds(20))
    try:
        yield Rig(bus, driver)
    finally:
        driver.close()


@pytest.fixture(params=FLAVOURS)
def rig(request: pytest.FixtureRequest, bus: UsbBusProcess) -> Iterator[Rig]:
    with running(bus, request.param) as rig:
        yield rig
