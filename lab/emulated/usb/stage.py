"""What the bench calls for a stage with USB devices: entry point ``usb`` of the group ``velatura.bench``."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path

from hal.runtime.files import read_text
from lab.emulated.usb.bench import UsbDevices, read_usb
from lab.emulated.usb.camera import STAGE_CAMERA, ExposureServer
from lab.emulated.usb.mains import Mains, check_mains
from plugins.emulated.bench import OutputLines
from plugins.emulated.core.shot import Expose
from plugins.emulated.core.truth import BenchTruth
from plugins.emulated.projectors.projector import BoardProjector


class StageUsbDevices:
    """``plugins.emulated.bench.UsbDevices`` of a stage. Raises DeviceError as ``read_usb`` and ``check_mains``."""

    def __init__(self, stage: Path, truth: BenchTruth) -> None:
        self._truth = truth
        self._devices = read_usb(stage)
        check_mains(truth.mains, truth.projectors, self._devices)

    @property
    def have_camera(self) -> bool:
        return any(device.kind == STAGE_CAMERA for device in self._devices)

    def serve(
        self,
        stack: contextlib.ExitStack,
        projectors: Mapping[str, BoardProjector],
        expose: Expose,
        out: OutputLines,
        scenario: Path | None,
    ) -> None:
        """Raises DeviceError ("usb-no-preload") where the preload library is missing."""
        camera = stack.enter_context(ExposureServer(expose)).camera(self._truth.camera) if self.have_camera else None
        script = read_text(scenario) if scenario is not None else ""
        bus = stack.enter_context(UsbDevices(self._devices, script, stage_camera=camera))
        for device in self._devices:
            out.served(device.name, device.kind, "usb")
        stack.enter_context(Mains(self._truth.mains, projectors, bus.moves, out.mains))
        out.environment(bus.environment)
