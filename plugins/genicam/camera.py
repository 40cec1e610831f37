"""The driver ``genicam``: machine vision cameras on the network or USB, through the library Aravis."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from hal.deadline import Deadline
from hal.errors import DeviceGone, PluginError
from hal.registry import Driver, OpenContext, setting
from hal.values import CameraCapabilities, CapturedFile, DeviceIdentity, ExposureSettings
from plugins.genicam.tiff import pixel_format
from plugins.library_process import CRASHED, LibraryProcess


class GenicamCamera:
    """A camera by Aravis (``hal.interfaces.Camera``). The library runs in a process of its own.

    ``name``: serial number, network address or Aravis' name; "" takes the first. ``pixels``: a format's name, "" for
    the best. ``black_level`` in raw steps; ``matrix``: XYZ (D65) to camera, nine numbers or none.
    """

    def __init__(
        self,
        *,
        name: str,
        serial: str,
        pixels: str,
        black_level: int,
        matrix: tuple[float, ...],
        deadline: Deadline,
    ) -> None:
        self._notes: deque[tuple[str, str]] = deque(maxlen=1000)
        self.process = LibraryProcess(
            "plugins.genicam.worker",
            "Aravis",
            start=(name, pixels, black_level, matrix),
            serial=serial,
            note=lambda code, what: self._notes.append((code, what)),
        )
        self._settings: ExposureSettings | None = None
        try:
            self._capabilities: CameraCapabilities = self.process.request("capabilities", deadline=deadline)
        except BaseException:
            self.close()
            raise

    @property
    def capabilities(self) -> CameraCapabilities:
        return self._capabilities

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        identity: DeviceIdentity = self.process.request("identity", deadline=deadline)
        return identity

    def configure(self, settings: ExposureSettings, *, deadline: Deadline) -> ExposureSettings:
        confirmed: ExposureSettings = self.process.request("configure", settings, deadline=deadline)
        self._settings = confirmed
        return confirmed

    def capture(self, destination: Path, *, deadline: Deadline) -> list[CapturedFile]:
        """See ``hal.interfaces.Camera.capture``. Raises DeviceGone("camera-shot-lost") where the process ended."""
        try:
            if self.process.pid is None and self._settings is not None:
                # A process that was ended by a deadline has forgotten its exposure.
                self.process.request("configure", self._settings, deadline=deadline)
            files: list[CapturedFile] = self.process.request(
                "capture", destination.absolute(), deadline.left_s(), deadline=deadline, repeatable=False
            )
        except DeviceGone as error:
            if error.code != CRASHED:
                raise
            raise DeviceGone(
                "camera-shot-lost",
                what=f"The connection to the camera was lost during a picture: {error.what}",
                remedy="Check cable and power, then take this picture again. It was not taken twice.",
            ) from error
        return files

    def close(self) -> None:
        self.process.close()


def _settings(settings: Mapping[str, Any]) -> tuple[str, int, tuple[float, ...]]:
    """Format, black level and colour matrix. Raises PluginError."""
    pixels = setting(settings, "format", str, "")
    if pixels and pixel_format(pixels) is None:
        raise PluginError(
            "camera-format",
            what=f"The format {pixels!r} can't be read.",
            remedy='Write one without packing, such as "BayerRG12", for format in the [camera] table.',
        )
    black_level = setting(settings, "black_level", int, 0)
    matrix = setting(settings, "color_matrix", list, [])
    numbers = [value for value in matrix if isinstance(value, int | float) and not isinstance(value, bool)]
    if len(matrix) not in (0, 9) or len(numbers) != len(matrix) or not 0 <= black_level < 65535:
        raise PluginError(
            "camera-setting",
            what="The camera's black_level or color_matrix is wrong.",
            remedy="Write a whole number of raw steps for black_level, and nine numbers for color_matrix.",
        )
    return pixels, black_level, tuple(float(value) for value in numbers)


def check_camera(settings: Mapping[str, Any], context: OpenContext) -> None:
    """As ``hal.registry.Driver.check``."""
    _settings(settings)


def open_camera(settings: Mapping[str, Any], context: OpenContext, deadline: Deadline) -> GenicamCamera:
    """Open the camera of a ``[camera]`` table."""
    pixels, black_level, matrix = _settings(settings)
    return GenicamCamera(
        name=str(settings.get("address", "")),
        serial=str(settings.get("serial", "")),
        pixels=pixels,
        black_level=black_level,
        matrix=matrix,
        deadline=deadline,
    )


DRIVER: Final = Driver(
    kind="camera",
    name="genicam",
    summary="Machine vision cameras (GigE Vision, USB3 Vision) by Aravis (needs Debian's libaravis-0.8-0).",
    open=open_camera,
    settings={
        "address": "network address, or Aravis' name of the camera (default: the first camera found)",
        "serial": "serial number that the camera must have (default: any)",
        "format": "pixel format without packing, such as BayerRG12 (default: a mosaic with the most bits)",
        "black_level": "raw steps without light, as the maker states them (default 0; the calibration measures it)",
        "color_matrix": "nine numbers from XYZ (D65) to the camera's colours, row by row (default: unknown)",
    },
    check=check_camera,
)
