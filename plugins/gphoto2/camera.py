"""The driver ``gphoto2``: the cameras that libgphoto2 knows, through the wheel of the same name (extra ``gphoto2``).

For a camera with PTP use the driver ``ptp``: it survives a lost connection during a picture. This driver also
never takes a picture twice, but reports that it was lost.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, TypeVar

from hal.deadline import Deadline
from hal.errors import DeviceError, DeviceGone, DeviceRefused, DeviceTimeout, PluginError
from hal.registry import Driver, OpenContext
from hal.values import CameraCapabilities, CameraStatus, CapturedFile, DeviceIdentity, ExposureSettings
from plugins.gphoto2 import opened as device
from plugins.gphoto2.errors import shot_lost, translated
from plugins.gphoto2.opened import Opened
from plugins.worker_link import WorkerLink

Result = TypeVar("Result")

_LISTEN_MS: Final = 50
_MOST_FILES: Final = 8


class _Lost(Exception):
    """The library's handle is not usable any more."""


class Gphoto2Camera(WorkerLink[Opened]):
    """A camera through libgphoto2 (``hal.interfaces.Camera``, ``WatchedCamera``, ``LiveViewCamera``).

    ``port``: ``usb:001,004``, ``ptpip:host`` or "" for the first camera that is found; ``serial``: the number it must
    have, "" takes the first and stays with it.
    """

    def __init__(self, library: Any, *, port: str, serial: str, deadline: Deadline) -> None:
        super().__init__("camera", broken=(_Lost,))
        self._library = library
        self._port = port
        self._serial = serial
        self._troubles: list[tuple[str, str]] = []
        try:
            self._capabilities = self._do(device.capabilities, deadline)
        except BaseException:
            self.close()
            raise

    @property
    def capabilities(self) -> CameraCapabilities:
        return self._capabilities

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        return self._do(device.identity, deadline)

    def configure(self, settings: ExposureSettings, *, deadline: Deadline) -> ExposureSettings:
        return self._do(lambda opened: device.configure(opened, settings), deadline)

    def capture(self, destination: Path, *, deadline: Deadline) -> list[CapturedFile]:
        """See ``hal.interfaces.Camera.capture``. Raises DeviceGone("camera-shot-lost") where the connection broke."""
        return self._do(lambda opened: self._shoot(opened, destination, deadline), deadline, repeatable=False)

    def status(self, *, deadline: Deadline) -> CameraStatus:
        return self._do(device.status, deadline)

    def troubles(self) -> list[tuple[str, str]]:
        found, self._troubles = self._troubles, []
        return found

    def live_view(self, *, deadline: Deadline) -> bytes:
        if not self._capabilities.live_view:
            raise DeviceRefused(
                "camera-no-live-view",
                what="The camera has no live view over its cable.",
                remedy="Use its viewfinder, or take a test picture to aim.",
            )
        return self._do(device.frame, deadline)

    def end_live_view(self, *, deadline: Deadline) -> None:
        def end(opened: Opened) -> None:
            if "viewfinder" in {child.get_name() for child in device.children(opened.camera.get_config())}:
                widget = opened.camera.get_single_config("viewfinder")
                widget.set_value(0)
                opened.camera.set_single_config("viewfinder", widget)

        if self._capabilities.live_view:
            self._do(end, deadline)

    def find(self) -> Opened:
        failure: DeviceError = DeviceGone(
            "camera-off",
            what=f"libgphoto2 finds no camera{f' at {self._port}' if self._port else ''}.",
            remedy="Switch the camera on, check its cable and its battery, then try again.",
        )
        for port in self._ports():
            camera = self._library.Camera()
            try:
                if port:
                    ports = self._library.PortInfoList()
                    ports.load()
                    camera.set_port_info(ports[ports.lookup_path(port)])
                camera.init()
                opened = Opened(self._library, camera)
                serial = opened.text("serialnumber")
            except self._library.GPhoto2Error as error:
                failure = translated(self._library, error)
                continue
            if not self._serial or serial == self._serial:
                self._serial = serial
                return opened
            self.let_go(opened)
            failure = DeviceRefused(
                "camera-other",
                what=f"The connected camera has the serial number {serial or '(none)'}, not {self._serial}.",
                remedy="Connect the right camera, or change serial in stage.toml and recalibrate.",
            )
        raise failure

    def let_go(self, opened: Opened) -> None:
        with contextlib.suppress(self._library.GPhoto2Error):
            opened.camera.exit()

    def _ports(self) -> list[str]:
        """Where to search: at the given port, then, once the serial number is known, everywhere."""
        named = [self._port] if self._port else []
        found = self._library.Camera.autodetect()
        others = [found.get_value(at) for at in range(found.count())]
        return named + [port for port in others if port != self._port] if self._serial or not named else named

    def _do(self, work: Callable[[Opened], Result], deadline: Deadline, *, repeatable: bool = True) -> Result:
        """Do ``work`` on the worker; convert the library's errors, and open a lost handle again."""

        def guarded(opened: Opened) -> Result:
            if opened.lost:
                raise _Lost
            try:
                return work(opened)
            except self._library.GPhoto2Error as error:
                meant = translated(self._library, error)
                opened.lost = isinstance(meant, DeviceGone | DeviceTimeout)
                if not opened.lost:
                    raise meant from error
                self._troubles.append((meant.code, meant.what))
                if repeatable:
                    raise _Lost from error
                raise shot_lost(meant) from error

        return self.call(guarded, deadline=deadline)

    def _shoot(self, opened: Opened, destination: Path, deadline: Deadline) -> list[CapturedFile]:
        library = self._library
        first = opened.camera.capture(library.GP_CAPTURE_IMAGE)
        found = [(first.folder, first.name)]
        wanted = 2 if "+" in (opened.text(opened.names["format"]) if "format" in opened.names else "") else 1
        while len(found) < wanted and not deadline.passed:
            kind, data = opened.camera.wait_for_event(_LISTEN_MS)
            if kind == library.GP_EVENT_FILE_ADDED and len(found) < _MOST_FILES:
                found.append((data.folder, data.name))
        captured = device.fetched(opened, found, destination)
        with contextlib.suppress(library.GPhoto2Error):
            for folder, name in found:
                opened.camera.file_delete(folder, name)
        return captured


def load_library() -> Any:
    """The wheel's module. Raises PluginError("gphoto2-missing")."""
    try:
        import gphoto2
    except ImportError as error:
        raise PluginError(
            "gphoto2-missing",
            what=f"The library for this camera is not installed ({error}).",
            remedy="Install it into Velatura's environment: pip install 'velatura[gphoto2]'.",
        ) from error
    return gphoto2


def open_camera(settings: Mapping[str, Any], context: OpenContext, deadline: Deadline) -> Gphoto2Camera:
    """Open the camera of a ``[camera]`` table."""
    port, serial = str(settings.get("address", "")), str(settings.get("serial", ""))
    return Gphoto2Camera(load_library(), port=port, serial=serial, deadline=deadline)


DRIVER: Final = Driver(
    kind="camera",
    name="gphoto2",
    summary="Cameras of libgphoto2 without (good) PTP support (needs the extra gphoto2).",
    open=open_camera,
    settings={
        "address": "libgphoto2's port, such as usb:001,004 (default: the first camera found)",
        "serial": "serial number that the camera must have (default: any)",
    },
    required=(),
)
