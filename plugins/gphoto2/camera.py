"""The driver ``gphoto2``: the cameras that libgphoto2 knows, through the wheel of the same name (extra ``gphoto2``).

For a standard camera or a Canon EOS use the driver ``ptp``: it survives a lost connection during a picture. This driver
also never takes a picture twice, but reports that it was lost. The library runs in a process of its own (``worker``).
"""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from typing import Any, Final

from hal.deadline import Deadline
from hal.errors import DeviceRefused
from hal.registry import Driver, OpenContext
from hal.values import CameraStatus
from plugins.gphoto2.library import load_library
from plugins.library_process import LibraryCamera


class Gphoto2Camera(LibraryCamera):
    """A camera through libgphoto2 (``hal.interfaces.Camera``, ``WatchedCamera``, ``LiveViewCamera``).

    ``port``: ``usb:001,004``, ``ptpip:host`` or "" for the first camera that is found; ``serial``: the number it must
    have, "" takes the first and stays with it.
    """

    def __init__(self, *, port: str, serial: str, deadline: Deadline) -> None:
        super().__init__("plugins.gphoto2.worker", "libgphoto2", start=(port,), serial=serial, deadline=deadline)

    def status(self, *, deadline: Deadline) -> CameraStatus:
        status: CameraStatus = self.process.request("status", deadline=deadline)
        return status

    def live_view(self, *, deadline: Deadline) -> bytes:
        if not self._capabilities.live_view:
            raise DeviceRefused(
                "camera-no-live-view",
                what="The camera has no live view over its cable.",
                remedy="Use its viewfinder, or take a test picture to aim.",
            )
        frame: bytes = self.process.request("live_view", deadline=deadline)
        return frame

    def end_live_view(self, *, deadline: Deadline) -> None:
        if self._capabilities.live_view:
            self.process.request("end_live_view", deadline=deadline)


def open_camera(settings: Mapping[str, Any], context: OpenContext, deadline: Deadline) -> Gphoto2Camera:
    """Open the camera of a ``[camera]`` table."""
    if importlib.util.find_spec("gphoto2") is None:
        load_library()  # raises; where it is there, only the process loads it
    port, serial = str(settings.get("address", "")), str(settings.get("serial", ""))
    return Gphoto2Camera(port=port, serial=serial, deadline=deadline)


DRIVER: Final = Driver(
    kind="camera",
    name="gphoto2",
    summary="Cameras that libgphoto2 knows, such as those of Nikon and Sony (needs the extra gphoto2).",
    open=open_camera,
    settings={
        "address": "libgphoto2's port, such as usb:001,004 or ptpip:192.168.1.20 (default: the first camera on USB)",
        "serial": "serial number that the camera must have (default: any)",
    },
    required=(),
)
