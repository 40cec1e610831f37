"""The process in which Aravis runs; see ``plugins.library_process``.

Its functions that a still camera needs are called by ctypes. Every pointer is the library's own. A wrong one ends the
process, so nothing else may load this module.
"""

from __future__ import annotations

import ctypes
import sys
import time
from collections.abc import Callable
from ctypes import POINTER, byref, c_char_p, c_double, c_int, c_size_t, c_uint, c_uint32, c_uint64, c_void_p
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from hal.codecs.ptp.values import printable
from hal.errors import DeviceBusy, DeviceError, DeviceGone, DeviceRefused, DeviceTimeout, PluginError
from hal.values import CameraCapabilities, CapturedFile, DeviceIdentity, ExposureSettings, FileKind
from plugins.camera_files import PendingFile, commit_all
from plugins.library_process import DeviceWorker, served
from plugins.ptp.body import nearest, no_such_file
from plugins.raw_file import Levels, PixelFormat, best_format, encoded, pixel_format

LIBRARY: Final = "libaravis-0.8.so.0"
CONTROL_S: Final = 6.0
_SUCCESS: Final = 0
_TIMEOUT: Final = 5
_GONE: Final = frozenset({6, 7})
"""Codes of ArvDeviceError: no answer in time; not connected, not found."""
_SIGNATURES: Final[dict[str, tuple[Any, tuple[Any, ...]]]] = {
    "arv_camera_new": (c_void_p, (c_char_p, c_void_p)),
    "arv_camera_is_gv_device": (c_int, (c_void_p,)),
    "arv_camera_get_device": (c_void_p, (c_void_p,)),
    "arv_gv_device_is_controller": (c_int, (c_void_p,)),
    "arv_gv_device_take_control": (c_int, (c_void_p, c_void_p)),
    "arv_camera_get_vendor_name": (c_char_p, (c_void_p, c_void_p)),
    "arv_camera_get_model_name": (c_char_p, (c_void_p, c_void_p)),
    "arv_camera_get_device_serial_number": (c_char_p, (c_void_p, c_void_p)),
    "arv_camera_get_exposure_time_bounds": (None, (c_void_p, POINTER(c_double), POINTER(c_double), c_void_p)),
    "arv_camera_get_exposure_time": (c_double, (c_void_p, c_void_p)),
    "arv_camera_set_exposure_time": (None, (c_void_p, c_double, c_void_p)),
    "arv_camera_get_pixel_format_as_string": (c_char_p, (c_void_p, c_void_p)),
    "arv_camera_set_pixel_format_from_string": (None, (c_void_p, c_char_p, c_void_p)),
    "arv_camera_dup_available_pixel_formats_as_strings": (POINTER(c_char_p), (c_void_p, POINTER(c_uint), c_void_p)),
    "arv_camera_is_feature_available": (c_int, (c_void_p, c_char_p, c_void_p)),
    "arv_camera_set_string": (None, (c_void_p, c_char_p, c_char_p, c_void_p)),
    "arv_camera_acquisition": (c_void_p, (c_void_p, c_uint64, c_void_p)),
    "arv_buffer_get_status": (c_int, (c_void_p,)),
    "arv_buffer_get_image_width": (c_int, (c_void_p,)),
    "arv_buffer_get_image_height": (c_int, (c_void_p,)),
    "arv_buffer_get_data": (c_void_p, (c_void_p, POINTER(c_size_t))),
    "g_object_unref": (None, (c_void_p,)),
    "g_error_free": (None, (c_void_p,)),
    "g_free": (None, (c_void_p,)),
}


class _Error(ctypes.Structure):
    _fields_ = [("domain", c_uint32), ("code", c_int), ("message", c_char_p)]


@dataclass(frozen=True, slots=True)
class Frame:
    """An image as it came: ``data`` of ``format`` (PFNC's name), whole rows from the top."""

    width_px: int
    height_px: int
    format: str
    data: bytes


class AravisCamera:
    """One open camera. ``name``: Aravis' own, the serial number or the network address; "" takes the first.

    Raises DeviceGone, DeviceBusy, DeviceRefused, DeviceTimeout; PluginError("aravis-missing") without the library.
    """

    def __init__(self, name: str) -> None:
        self._library = _loaded()
        self._camera = self._call("arv_camera_new", name.encode() or None)
        if not self._camera:
            raise _gone("none was found")
        self._take_control()

    def _take_control(self) -> None:
        """On a network, one program has a camera until its heartbeats stop: for three seconds after it has crashed."""
        if not self._library.arv_camera_is_gv_device(self._camera):
            return
        device, ends_s = self._library.arv_camera_get_device(self._camera), time.monotonic() + CONTROL_S
        while not self._library.arv_gv_device_is_controller(device):
            try:
                self._call("arv_gv_device_take_control", device)
            except DeviceError:
                if time.monotonic() > ends_s:
                    self.close()
                    raise
                time.sleep(0.2)

    def text(self, what: str) -> str:
        """``vendor_name``, ``model_name``, ``device_serial_number``, ``pixel_format_as_string``."""
        return printable((self._call(f"arv_camera_get_{what}", self._camera) or b"").decode(errors="replace"))

    def exposure_bounds_s(self) -> tuple[float, float]:
        low, high = c_double(), c_double()
        self._call("arv_camera_get_exposure_time_bounds", self._camera, byref(low), byref(high))
        return low.value / 1e6, high.value / 1e6

    def set_exposure(self, seconds: float) -> float:
        """Set it; return what the camera has then."""
        self._call("arv_camera_set_exposure_time", self._camera, c_double(1e6 * seconds))
        return float(self._call("arv_camera_get_exposure_time", self._camera)) / 1e6

    def formats(self) -> list[str]:
        """The names of its pixel formats."""
        count = c_uint()
        names = self._call("arv_camera_dup_available_pixel_formats_as_strings", self._camera, byref(count))
        try:
            return [printable(names[at].decode(errors="replace")) for at in range(count.value)]
        finally:
            self._library.g_free(names)

    def set_format(self, name: str) -> None:
        self._call("arv_camera_set_pixel_format_from_string", self._camera, name.encode())

    def has(self, feature: str) -> bool:
        return bool(self._call("arv_camera_is_feature_available", self._camera, feature.encode()))

    def choose(self, feature: str, value: str) -> None:
        """Set an enumeration, where the camera has it."""
        if self.has(feature):
            self._call("arv_camera_set_string", self._camera, feature.encode(), value.encode())

    def frame(self, seconds: float) -> Frame:
        """One image, exposed after this call began."""
        buffer = self._call("arv_camera_acquisition", self._camera, c_uint64(int(1e6 * max(seconds, 0.001))))
        if not buffer:
            raise _late()
        try:
            if self._library.arv_buffer_get_status(buffer) != _SUCCESS:
                raise DeviceBusy(
                    "camera-frame-cut",
                    what="The camera sent an incomplete image.",
                    remedy="Use a wired network with large packets (MTU 9000), or a faster USB port.",
                )
            size = c_size_t()
            data = self._library.arv_buffer_get_data(buffer, byref(size))
            width, height = (int(getattr(self._library, f"arv_buffer_get_image_{side}")(buffer)) for side in _SIDES)
            return Frame(width, height, self.text("pixel_format_as_string"), ctypes.string_at(data, size.value))
        finally:
            self._library.g_object_unref(buffer)

    def close(self) -> None:
        camera, self._camera = self._camera, None
        if camera:
            self._library.g_object_unref(camera)

    def _call(self, name: str, *arguments: Any) -> Any:
        """Call a function whose last parameter takes a GError."""
        error = POINTER(_Error)()
        result = getattr(self._library, name)(*arguments, ctypes.cast(ctypes.pointer(error), c_void_p))
        if error:
            code, said = error.contents.code, (error.contents.message or b"").decode(errors="replace")
            self._library.g_error_free(ctypes.cast(error, c_void_p))
            raise _device_error(code, printable(said))
        return result


_SIDES: Final = ("width", "height")


def _loaded() -> Any:
    try:
        library = ctypes.CDLL(LIBRARY)
    except OSError as error:
        raise PluginError(
            "aravis-missing",
            what=f"The library for GenICam cameras is not installed ({error}).",
            remedy="Install Debian's package libaravis-0.8-0.",
        ) from error
    for name, (returns, takes) in _SIGNATURES.items():
        function: Callable[..., Any] = getattr(library, name)
        function.restype, function.argtypes = returns, takes  # type: ignore[attr-defined]
    return library


def _device_error(code: int, said: str) -> DeviceError:
    if code == _TIMEOUT:
        return _late()
    if code in _GONE:
        return _gone(said)
    return DeviceRefused(
        "camera-refused",
        what=f"The camera refused a command ({said}).",
        remedy="End other programs that use it, and check its settings with the maker's own program.",
    )


def _gone(said: str) -> DeviceGone:
    return DeviceGone(
        "camera-off",
        what=f"Aravis finds no such camera ({said}).",
        remedy="Check its power, its cable, and that this computer's network address fits the camera's.",
    )


def _late() -> DeviceTimeout:
    return DeviceTimeout(
        "camera-no-picture",
        what="The camera sent no image in time.",
        remedy="Check its trigger settings: it must run freely.",
    )


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
