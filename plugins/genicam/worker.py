"""The process in which Aravis runs; see ``plugins.library_process``."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Final

from hal.errors import DeviceBusy, DeviceRefused, PluginError
from hal.values import CameraCapabilities, CapturedFile, DeviceIdentity, ExposureSettings, FileKind
from plugins.camera_files import PendingFile, commit_all
from plugins.genicam.aravis import AravisCamera, Frame
from plugins.library_process import DeviceWorker, served
from plugins.ptp.body import nearest, no_such_file
from plugins.raw_file import Levels, PixelFormat, best_format, encoded, pixel_format

_THIRDS: Final = tuple(2 ** (third / 3) for third in range(-48, 22))
"""Exposure times in seconds, from 1/65536 to 102, of which a camera has those within its bounds."""


class Worker(DeviceWorker[AravisCamera]):
    """The camera."""

    def __init__(self, name: str, wanted: str, levels: Levels, serial: str) -> None:
        super().__init__(serial)
        self._name = name
        self._wanted = wanted
        self._levels = levels
        self._pixels: PixelFormat | None = None
        self._exposure_s: float | None = None

    def capabilities(self) -> CameraCapabilities:
        self._open()
        return CameraCapabilities(tuple(self._times()), (), (), raw=True, jpeg=False)

    def identity(self) -> DeviceIdentity:
        camera = self._open()
        return DeviceIdentity(camera.text("vendor_name"), camera.text("model_name"), camera.text(_SERIAL))

    def configure(self, settings: ExposureSettings) -> ExposureSettings:
        camera = self._open()
        if not settings.raw:
            raise no_such_file(settings.raw)
        if settings.aperture_f is not None:
            raise DeviceRefused(
                "camera-setting-fixed",
                what="A machine vision camera can't set its lens.",
                remedy="Remove aperture_f from [capture] in stage.toml, and set the lens by hand.",
            )
        wanted_s = nearest(self._times(), settings.exposure_s, setting="exposure time in seconds")
        has_s = camera.set_exposure(wanted_s)
        self._exposure_s = wanted_s
        close = abs(has_s / wanted_s - 1) < 1e-3
        return ExposureSettings(wanted_s if close else round(has_s, 9), settings.iso, None, raw=True)

    def capture(self, destination: Path, seconds: float) -> list[CapturedFile]:
        camera = self._open()
        assert self._pixels is not None
        frame = _complete_frame(camera, seconds)
        data = encoded(
            frame.data,
            (frame.width_px, frame.height_px),
            pixel_format(frame.format) or self._pixels,
            maker=camera.text("vendor_name"),
            model=camera.text("model_name"),
            levels=self._levels,
        )
        path = destination.parent / f"{destination.name}{self._pixels.suffix}"
        with PendingFile(path, FileKind.RAW) as file:
            file.write(memoryview(data))
            return commit_all([file])

    def _open_device(self) -> AravisCamera:
        return AravisCamera(self._name)

    def _prepare(self, device: AravisCamera) -> None:
        serial = device.text(_SERIAL)
        if self._serial and serial != self._serial:
            raise DeviceRefused(
                "camera-other",
                what=f"The connected camera has the serial number {serial or '(none)'}, not {self._serial}.",
                remedy="Connect the right camera, or change serial in stage.toml and recalibrate.",
            )
        names = device.formats()
        self._pixels = pixel_format(self._wanted) if self._wanted else best_format(names)
        if self._pixels is None or self._pixels.name not in names:
            raise PluginError(
                "camera-format",
                what=f"The camera has no format {self._wanted or 'that can be read'}; it has {', '.join(names)}.",
                remedy="Write another one for format in the [camera] table, or leave it out.",
            )
        device.set_format(self._pixels.name)
        for automatic in ("ExposureAuto", "GainAuto", "BalanceWhiteAuto"):
            device.choose(automatic, "Off")
        if self._exposure_s is not None:
            device.set_exposure(self._exposure_s)  # it was off meanwhile
        self._serial = serial

    def _times(self) -> list[float]:
        low_s, high_s = self._open().exposure_bounds_s()
        return [round(time_s, 6) for time_s in _THIRDS if low_s <= round(time_s, 6) <= high_s]


def _complete_frame(camera: AravisCamera, seconds: float) -> Frame:
    """A frame of which no packet was lost. Another one costs nothing: there is no shutter that wears out."""
    ends_s = time.monotonic() + seconds
    while True:
        try:
            return camera.frame(ends_s - time.monotonic())
        except DeviceBusy:
            if time.monotonic() >= ends_s:
                raise


_SERIAL: Final = "device_serial_number"

if __name__ == "__main__":
    sys.exit(served(Worker))
