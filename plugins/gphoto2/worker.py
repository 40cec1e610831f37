"""The process in which libgphoto2 runs: `python -m plugins.gphoto2.worker FD` answers requests on a socket.

A fault in the library, or in a camera's driver of it, ends this process and not the controller. A call that hangs ends
with it, too: the controller kills it. Requests and answers are those of ``plugins.library_process``.
"""

from __future__ import annotations

import contextlib
import sys
import time
from pathlib import Path
from typing import Any, Final

from hal.errors import DeviceError, DeviceGone, DeviceRefused, DeviceTimeout
from hal.values import CameraCapabilities, CameraStatus, CapturedFile, DeviceIdentity, ExposureSettings
from plugins.gphoto2 import opened as device
from plugins.gphoto2.errors import translated
from plugins.gphoto2.library import load_library
from plugins.gphoto2.opened import Opened
from plugins.library_process import served, shot_lost
from plugins.library_worker import DeviceWorker

_LISTEN_MS: Final = 50
_MOST_FILES: Final = 8
_NETWORK: Final = "ptpip:"
_NETWORK_MODEL: Final = "PTP/IP Camera"
"""libgphoto2 can't ask the network for a camera's model, and needs this entry of its list."""


class Worker(DeviceWorker[Opened]):
    """The camera."""

    def __init__(self, library: Any, port: str, serial: str) -> None:
        super().__init__(serial)
        self._library = library
        self._port = port

    def capabilities(self) -> CameraCapabilities:
        return device.capabilities(self._open())

    def identity(self) -> DeviceIdentity:
        return device.identity(self._open())

    def status(self) -> CameraStatus:
        return device.status(self._open())

    def configure(self, settings: ExposureSettings) -> ExposureSettings:
        return device.configure(self._open(), settings)

    def live_view(self) -> bytes:
        return device.frame(self._open())

    def end_live_view(self) -> None:
        opened = self._open()
        if "viewfinder" in {child.get_name() for child in device.children(opened.camera.get_config())}:
            widget = opened.camera.get_single_config("viewfinder")
            widget.set_value(0)
            opened.camera.set_single_config("viewfinder", widget)

    def capture(self, destination: Path, seconds: float) -> list[CapturedFile]:
        """``seconds``: how long it may wait for the second file of RAW and JPEG."""
        opened, ends_s = self._open(), time.monotonic() + seconds
        library = self._library
        first = opened.camera.capture(library.GP_CAPTURE_IMAGE)
        found = [(first.folder, first.name)]
        wanted = 2 if "+" in (opened.text(opened.names["format"]) if "format" in opened.names else "") else 1
        while len(found) < wanted and time.monotonic() < ends_s:
            kind, data = opened.camera.wait_for_event(_LISTEN_MS)
            if kind == library.GP_EVENT_FILE_ADDED and len(found) < _MOST_FILES:
                found.append((data.folder, data.name))
        captured = device.fetched(opened, found, destination)
        with contextlib.suppress(library.GPhoto2Error):
            for folder, name in found:
                opened.camera.file_delete(folder, name)
        return captured

    def _do(self, name: str, arguments: tuple[Any, ...]) -> Any:
        try:
            return super()._do(name, arguments)
        except self._library.GPhoto2Error as error:
            translation = translated(self._library, error)
            lost = name == "capture" and isinstance(translation, DeviceGone | DeviceTimeout)
            raise (shot_lost(translation) if lost else translation) from error

    def _open_device(self) -> Opened:
        failure: DeviceError = DeviceGone(
            "camera-off",
            what=f"libgphoto2 finds no camera{f' at {self._port}' if self._port else ''}.",
            remedy="Switch the camera on, check its cable and its battery, then try again.",
        )
        for port in self._ports():
            camera = self._library.Camera()
            try:
                self._aim(camera, port)
                camera.init()
                opened = Opened(self._library, camera)
                serial = opened.text("serialnumber")
            except self._library.GPhoto2Error as error:
                failure = translated(self._library, error)
                continue
            if not self._serial or serial == self._serial:
                self._serial = serial
                return opened
            opened.close()
            failure = DeviceRefused(
                "camera-other",
                what=f"The connected camera has the serial number {serial or '(none)'}, not {self._serial}.",
                remedy="Connect the right camera, or change serial in stage.toml and recalibrate.",
            )
        raise failure

    def _aim(self, camera: Any, port: str) -> None:
        """Choose the port, and on the network the entry of the library's list of cameras."""
        if port:
            ports = self._library.PortInfoList()
            ports.load()
            camera.set_port_info(ports[ports.lookup_path(port)])
        if port.startswith(_NETWORK):
            known = self._library.CameraAbilitiesList()
            known.load()
            camera.set_abilities(known[known.lookup_model(_NETWORK_MODEL)])

    def _ports(self) -> list[str]:
        """Where to search: at the given port, then, once the serial number is known, everywhere."""
        named = [self._port] if self._port else []
        if self._port.startswith(_NETWORK):
            return named
        found = self._library.Camera.autodetect()
        others = [found.get_value(at) for at in range(found.count())]
        return named + [port for port in others if port != self._port] if self._serial or not named else named


def main() -> int:
    return served(lambda port, serial: Worker(load_library(), port, serial))


if __name__ == "__main__":
    sys.exit(main())
