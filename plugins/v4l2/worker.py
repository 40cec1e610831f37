"""The process that reads a video device, because a call into the kernel may hang; see ``plugins.library_process``."""

from __future__ import annotations

import contextlib
import mmap
import os
import select
import sys
import time
from ctypes import c_int32
from pathlib import Path
from typing import Final

from hal.errors import DeviceBusy, DeviceError, DeviceGone, DeviceRefused, DeviceTimeout, PluginError
from hal.values import CameraCapabilities, CapturedFile, DeviceIdentity, ExposureSettings, FileKind
from plugins.camera_files import PendingFile, commit_all
from plugins.library_process import DeviceWorker, served
from plugins.ptp.body import nearest, no_such_file
from plugins.raw_file import encoded
from plugins.v4l2 import kernel
from plugins.v4l2.formats import (
    COMPRESSED,
    VideoFormat,
    VideoSettings,
    code_of,
    is_complete_jpeg,
    jpeg_file,
    number_of,
    rank,
    video_format,
)
from plugins.v4l2.kernel import VideoNode, chosen, identify

_BUFFERS: Final = 4
_GOING_S: Final = 0.5
"""Linux takes a pulled camera away in this time. Closing its device meanwhile can meet a fault of the kernel (seen with
6.1), which ends this process: ``media_device_unregister_entity`` reads a pointer before it has the lock."""
_MOST: Final = 4096
"""Entries of a list that are read, in case a driver's lists never end."""


class VideoDevice:
    """Opened for reading pictures; its methods raise DeviceGone, DeviceRefused. Close it."""

    def __init__(self, path: Path) -> None:
        self._frame_bytes = self._row_bytes = 0
        self.size_px = (0, 0)
        self.format = VideoFormat("")
        self._maps: list[mmap.mmap] = []
        try:
            self._handle = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            raise kernel.device_error(error) from error
        try:
            node = identify(path, self._handle)
            if node is None:
                raise DeviceRefused(
                    "camera-no-capture",
                    what=f"{path} takes no pictures.",
                    remedy="Write another video device for address in the [camera] table.",
                )
            self.node: VideoNode = node
        except BaseException:
            os.close(self._handle)
            raise

    def close(self) -> None:
        for each in self._maps:
            each.close()
        self._maps.clear()
        if self._is_gone():
            time.sleep(_GOING_S)
        os.close(self._handle)

    def _is_gone(self) -> bool:
        try:
            kernel.answered(self._handle, kernel.QUERYCAP, kernel.Capability())
        except DeviceGone:
            return True
        return False

    def codes(self) -> list[str]:
        """The codes of its formats."""
        codes = []
        for index in range(_MOST):
            description = kernel.FormatDescription(index=index, type=kernel.CAPTURE)
            if not kernel.answered(self._handle, kernel.ENUM_FMT, description):
                break
            codes.append(code_of(description.pixelformat))
        return [code for code in codes if code]

    def largest_px(self, code: str) -> tuple[int, int]:
        """The size with the most pixels; (0, 0) where the driver has no list."""
        best = (0, 0)
        for index in range(_MOST):
            frame_size = kernel.FrameSize(index=index, pixelformat=number_of(code))
            if not kernel.answered(self._handle, kernel.ENUM_FRAMESIZES, frame_size):
                break
            discrete = frame_size.type == kernel.DISCRETE
            size = (
                (frame_size.sides[0], frame_size.sides[1]) if discrete else (frame_size.sides[1], frame_size.sides[4])
            )
            best = max(best, size, key=lambda sides: sides[0] * sides[1])
            if not discrete:
                break
        return best

    def set_format(self, video: VideoFormat, size_px: tuple[int, int]) -> None:
        """Set format and size; ``size_px`` (0, 0) leaves the size. Raises DeviceRefused where it takes another."""
        frame_format = kernel.Format(type=kernel.CAPTURE)
        frame_format.fmt.pix.width, frame_format.fmt.pix.height = size_px
        frame_format.fmt.pix.pixelformat, frame_format.fmt.pix.field = number_of(video.code), kernel.DISCRETE
        kernel.call(self._handle, kernel.S_FMT, frame_format)
        has = frame_format.fmt.pix
        if has.pixelformat != number_of(video.code) or size_px not in ((0, 0), (has.width, has.height)):
            raise DeviceRefused(
                "camera-format",
                what=f"The camera has no {video.code.strip()} of {size_px[0]} x {size_px[1]};"
                f" it takes {code_of(has.pixelformat).strip()} of {has.width} x {has.height}.",
                remedy="Write another format or size in the [camera] table, or leave them out.",
            )
        self.format, self.size_px = video, (has.width, has.height)
        self._row_bytes, self._frame_bytes = has.bytesperline, has.sizeimage

    def control(self, identifier: int) -> kernel.ControlQuery | None:
        """Range of a control that can be set; None where it has none."""
        query = kernel.ControlQuery(id=identifier)
        usable = kernel.answered(self._handle, kernel.QUERYCTRL, query) and not query.flags & kernel.UNUSABLE
        return query if usable else None

    def set_control(self, identifier: int, value: int) -> int:
        """Set a control; return what it has then."""
        control = kernel.Control(id=identifier, value=value)
        kernel.call(self._handle, kernel.S_CTRL, control)
        kernel.call(self._handle, kernel.G_CTRL, control)
        return int(control.value)

    def stop_automatics(self) -> None:
        """Exposure, gain, white balance and the like are left as they are now."""
        values = dict(kernel.AUTOMATIC)
        if self.node.driver == "uvcvideo":
            values.update([kernel.UVC_GAMMA])
        for identifier, value in values.items():
            control = self.control(identifier)
            if control is not None and control.minimum <= value <= control.maximum:
                # A menu need not have this entry: then it is left.
                with contextlib.suppress(DeviceRefused):
                    self.set_control(identifier, value)

    def set_interval(self, longest_s: float) -> None:
        """The shortest time between frames in which an exposure of ``longest_s`` has room, or the longest."""
        intervals = self._intervals()
        if not intervals:
            return
        room = [interval for interval in intervals if interval[0] / interval[1] >= longest_s]
        by_time = sorted(room or intervals, key=lambda interval: interval[0] / interval[1])
        numerator, denominator = by_time[0] if room else by_time[-1]
        parameters = kernel.Parameters(type=kernel.CAPTURE, numerator=numerator, denominator=denominator)
        kernel.answered(self._handle, kernel.S_PARM, parameters)

    def _intervals(self) -> list[tuple[int, int]]:
        intervals = []
        for index in range(_MOST):
            interval = kernel.FrameInterval(index=index, pixelformat=number_of(self.format.code))
            interval.width, interval.height = self.size_px
            if not kernel.answered(self._handle, kernel.ENUM_FRAMEINTERVALS, interval):
                break
            pairs = [
                (interval.parts[at], interval.parts[at + 1])
                for at in range(0, 2 if interval.type == kernel.DISCRETE else 4, 2)
            ]
            intervals += [pair for pair in pairs if pair[0] and pair[1]]
            if interval.type != kernel.DISCRETE:
                break
        return intervals

    def frame(self, skip: int, seconds: float) -> bytes:
        """Start, pass over ``skip`` whole frames, take the next one, stop; rows are without padding.

        Raises DeviceTimeout, or DeviceBusy("camera-frame-cut") where frames came and none was whole.
        """
        ends_s = time.monotonic() + seconds
        self._map_buffers()
        try:
            for index in range(len(self._maps)):
                kernel.call(self._handle, kernel.QBUF, self._buffer(index))
            kernel.call(self._handle, kernel.STREAMON, c_int32(kernel.CAPTURE))
            return self._complete_frame(skip, ends_s)
        finally:
            self._stop()

    def _map_buffers(self) -> None:
        request = kernel.Buffers(count=_BUFFERS, type=kernel.CAPTURE, memory=kernel.MMAP)
        kernel.call(self._handle, kernel.REQBUFS, request)
        for index in range(request.count):
            buffer = self._buffer(index)
            kernel.call(self._handle, kernel.QUERYBUF, buffer)
            try:
                self._maps.append(mmap.mmap(self._handle, buffer.length, offset=buffer.m.offset))
            except OSError as error:
                raise kernel.device_error(error) from error

    def _buffer(self, index: int) -> kernel.Buffer:
        return kernel.Buffer(index=index, type=kernel.CAPTURE, memory=kernel.MMAP)

    def _complete_frame(self, skip: int, ends_s: float) -> bytes:
        watch = select.poll()
        watch.register(self._handle, select.POLLIN)
        cut = 0
        while True:
            left_s = ends_s - time.monotonic()
            if left_s <= 0 or not watch.poll(1000 * left_s):
                raise _cut(cut) if cut else _late()
            buffer = kernel.Buffer(type=kernel.CAPTURE, memory=kernel.MMAP)
            kernel.call(self._handle, kernel.DQBUF, buffer)
            data = self._maps[buffer.index][: buffer.bytesused]
            if buffer.flags & kernel.BAD_FRAME or not self._is_complete(data):
                cut += 1
            elif skip:
                skip -= 1
            else:
                return self._rows(data)
            kernel.call(self._handle, kernel.QBUF, self._buffer(buffer.index))

    def _is_complete(self, data: bytes) -> bool:
        if self.format.code in COMPRESSED:
            return is_complete_jpeg(data)
        columns, rows = self.size_px
        row = columns * self.format.bytes_per_pixel
        return len(data) >= max(self._row_bytes, row) * (rows - 1) + row

    def _rows(self, data: bytes) -> bytes:
        row = self.size_px[0] * self.format.bytes_per_pixel
        if self.format.code in COMPRESSED or self._row_bytes <= row:
            return data
        starts = range(0, self.size_px[1] * self._row_bytes, self._row_bytes)
        return b"".join(data[at : at + row] for at in starts)

    def _stop(self) -> None:
        # A camera that was unplugged refuses this, and needs none.
        with contextlib.suppress(DeviceError):
            kernel.call(self._handle, kernel.STREAMOFF, c_int32(kernel.CAPTURE))
        for each in self._maps:
            each.close()
        self._maps.clear()
        with contextlib.suppress(DeviceError):
            kernel.call(self._handle, kernel.REQBUFS, kernel.Buffers(count=0, type=kernel.CAPTURE, memory=kernel.MMAP))


def _cut(count: int) -> DeviceBusy:
    return DeviceBusy(
        "camera-frame-cut",
        what=f"The camera sent {count} incomplete images and no whole one.",
        remedy="Use another USB port or a shorter cable, and no hub. A smaller size needs less bandwidth.",
    )


def _late() -> DeviceTimeout:
    return DeviceTimeout(
        "camera-no-picture",
        what="The camera sent no image in time.",
        remedy="Check that it is not set to wait for a trigger, and that its USB port has enough bandwidth.",
    )


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
        formats = [choice for code in codes if (choice := video_format(code, settings.bits)) is not None]
        choices = (
            [choice for choice in formats if choice.code.strip() == settings.format] if settings.format else formats
        )
        video: VideoFormat | None = max(choices, default=None, key=rank)
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
        control = device.control(kernel.EXPOSURE_ABSOLUTE)
        self._control = (kernel.EXPOSURE_ABSOLUTE, _ABSOLUTE_S)
        if control is None and self._settings.exposure_step_s:
            control = device.control(kernel.EXPOSURE)
            self._control = (kernel.EXPOSURE, self._settings.exposure_step_s)
        if control is None:
            self._control, self._steps = (0, 1.0), []
            return
        step_s, low, high, by = self._control[1], max(1, control.minimum), control.maximum, max(1, control.step)
        on_grid = {control.minimum + round((time_s / step_s - control.minimum) / by) * by for time_s in _THIRDS}
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
