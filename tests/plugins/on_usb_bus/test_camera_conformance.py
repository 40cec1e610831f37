"""The shared suite for cameras, on the emulated USB bus."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

import pytest

from hal.conformance import CameraConformance
from hal.deadline import in_seconds
from hal.registry import OpenContext
from lab.emulated.usb.process import UsbBusProcess
from plugins.ptp.camera import open_camera
from plugins.ptp.still import PtpCamera
from tests.plugins.on_usb_bus.camera_rig import bus, lasting_bus

__all__ = ["bus", "lasting_bus"]


class EveryFlavour(CameraConformance):
    flavour: ClassVar[str]
    patience_s = 60.0

    @pytest.fixture
    def camera(self, bus: UsbBusProcess, tmp_path_factory: pytest.TempPathFactory) -> Iterator[PtpCamera]:
        bus.add("camera", "camera", flavour=self.flavour, size=50_000, time_scale=0.01)
        context = OpenContext(tmp_path_factory.mktemp("stage"))
        camera = open_camera({"address": "usb:"}, context, in_seconds(20))
        yield camera
        camera.close()


class TestGeneric(EveryFlavour):
    flavour = "generic"


class TestEosNew(EveryFlavour):
    flavour = "eos-new"


class TestEosOld(EveryFlavour):
    flavour = "eos-old"
