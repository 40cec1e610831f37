"""The driver ``genicam``: machine vision cameras on the network or USB, through the library Aravis."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from hal.deadline import Deadline
from hal.errors import PluginError
from hal.registry import Driver, OpenContext, setting
from plugins.library_process import LibraryCamera
from plugins.raw_file import LEVEL_SETTINGS, Levels, levels_of, pixel_format


class GenicamCamera(LibraryCamera):
    """A camera by Aravis. The library runs in a process of its own.

    ``name``: serial number, network address or Aravis' name; "" takes the first. ``pixels``: a format's name, "" for
    the best.
    """

    def __init__(self, *, name: str, serial: str, pixels: str, levels: Levels, deadline: Deadline) -> None:
        start = (name, pixels, levels)
        super().__init__("plugins.genicam.worker", "Aravis", start=start, serial=serial, deadline=deadline)


def _format(settings: Mapping[str, Any]) -> str:
    """Raises PluginError for one that is not read."""
    pixels: str = setting(settings, "format", str, "")
    if pixels and pixel_format(pixels) is None:
        raise PluginError(
            "camera-format",
            what=f"The format {pixels!r} can't be read.",
            remedy='Write one without packing, such as "BayerRG12", for format in the [camera] table.',
        )
    return pixels


def check_camera(settings: Mapping[str, Any], context: OpenContext) -> None:
    """As ``hal.registry.Driver.check``."""
    _format(settings)
    levels_of(settings)


def open_camera(settings: Mapping[str, Any], context: OpenContext, deadline: Deadline) -> GenicamCamera:
    """Open the camera of a ``[camera]`` table."""
    return GenicamCamera(
        name=str(settings.get("address", "")),
        serial=str(settings.get("serial", "")),
        pixels=_format(settings),
        levels=levels_of(settings),
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
        **LEVEL_SETTINGS,
    },
    check=check_camera,
)
