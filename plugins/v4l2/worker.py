"""The process that reads a video device, because a call into the kernel may hang; see ``plugins.library_process``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Final

from hal.errors import DeviceRefused, PluginError
from hal.values import CameraCapabilities, CapturedFile, DeviceIdentity, ExposureSettings, FileKind
from plugins.camera_files import PendingFile, commit_all
from plugins.library_process import DeviceWorker, served
from plugins.ptp.body import nearest, no_such_file
from plugins.raw_file import encoded
from plugins.v4l2 import kernel
from plugins.v4l2.device import VideoDevice
from plugins.v4l2.formats import VideoFormat, VideoSettings, jpeg_file, rank, video_format
from plugins.v4l2.kernel import chosen

_THIRDS: Final = tuple(2 ** (third / 3) for third in range(-48, 22))
_ABSOLUTE_S: Final = 1e-4
"""One step of the control Exposure, Absolute."""


class Worker(DeviceWorker[VideoDevice]):
    """The camera."""

    def __init__(self, settings: VideoSettings, serial: str) -> None:
        super().__init__(serial)
        self._settings = settings
        self._bus = ""
        self._control = (0, 0.0)
        self._steps: list[int] = []
        self._wanted: int | None = None

    def capabilities(self) -> CameraCapabilities:
        device = self._open()
        return CameraCapabilities(tuple(self._times()), (), (), raw=device.format.raw, jpeg=not device.format.raw)

    def identity(self) -> DeviceIdentity:
        node = self._open().node
        return DeviceIdentity(node.maker, node.model, node.serial)

    def configure(self, settings: ExposureSettings) -> ExposureSettings:
        device = self._open()
        if settings.raw != device.format.raw:
            raise no_such_file(settings.raw)
        if settings.aperture_f is not None:
            raise DeviceRefused(
                "camera-setting-fixed",
                what="A video camera can't set its lens.",
                remedy="Remove aperture_f from [capture] in stage.toml, and set the lens by hand.",
            )
        wanted_s = nearest(self._times(), settings.exposure_s, setting="exposure time in seconds")
        self._wanted = round(wanted_s / self._control[1])
        has_s = self._expose(device)
        return ExposureSettings(has_s, settings.iso, None, raw=settings.raw)

    def capture(self, destination: Path, seconds: float) -> list[CapturedFile]:
        device = self._open()
        frame = device.frame(self._settings.skip_frames, seconds)
        samples = device.format.samples
        if samples is None:
            suffix, kind = ".jpg", FileKind.JPEG
            data = jpeg_file(frame, device.size_px, device.format.code)
        else:
            suffix, kind = samples.suffix, FileKind.RAW
            node, levels = device.node, self._settings.levels
            data = encoded(frame, device.size_px, samples, maker=node.maker, model=node.model, levels=levels)
        with PendingFile(destination.parent / f"{destination.name}{suffix}", kind) as file:
            file.write(memoryview(data))
            return commit_all([file])

    def _open_device(self) -> VideoDevice:
        return VideoDevice(chosen(self._settings.address, self._serial, self._bus).path)

    def _prepare(self, device: VideoDevice) -> None:
        settings = self._settings
        codes = device.codes()
        known = [one for code in codes if (one := video_format(code, settings.bits)) is not None]
        wanted = [one for one in known if one.code.strip() == settings.format] if settings.format else known
        video: VideoFormat | None = max(wanted, default=None, key=rank)
        if video is None:
            raise PluginError(
                "camera-format",
                what=f"The camera has no format {settings.format or 'that can be read'};"
                f" it has {', '.join(code.strip() for code in codes)}.",
                remedy="Write another one for format in the [camera] table, or leave it out.",
            )
        device.set_format(video, settings.size_px or device.largest_px(video.code))
        device.stop_automatics()
        self._measure_exposure(device)
        if self._wanted is not None:
            self._expose(device)
        self._serial, self._bus = device.node.serial, device.node.bus

    def _measure_exposure(self, device: VideoDevice) -> None:
        """Which control sets the exposure, and its steps."""
        found = device.control(kernel.EXPOSURE_ABSOLUTE)
        self._control = (kernel.EXPOSURE_ABSOLUTE, _ABSOLUTE_S)
        if found is None and self._settings.exposure_step_s:
            found = device.control(kernel.EXPOSURE)
            self._control = (kernel.EXPOSURE, self._settings.exposure_step_s)
        if found is None:
            self._control, self._steps = (0, 1.0), []
            return
        step_s, low, high, by = self._control[1], max(1, found.minimum), found.maximum, max(1, found.step)
        on_grid = {found.minimum + round((time_s / step_s - found.minimum) / by) * by for time_s in _THIRDS}
        self._steps = sorted(step for step in on_grid if low <= step <= high)

    def _times(self) -> list[float]:
        if not self._steps:
            raise PluginError(
                "camera-no-exposure",
                what="The exposure of this camera can't be set in seconds.",
                remedy="If it has a control named Exposure, write the time of one of its steps for exposure_step_s in"
                " the [camera] table; else use another camera.",
            )
        return [round(step * self._control[1], 9) for step in self._steps]

    def _expose(self, device: VideoDevice) -> float:
        """Set the wanted exposure; the seconds that the camera has then."""
        identifier, step_s = self._control
        assert self._wanted is not None
        device.set_interval(self._wanted * step_s)
        return round(device.set_control(identifier, self._wanted) * step_s, 9)


if __name__ == "__main__":
    sys.exit(served(Worker))
