"""The process in which libgphoto2 runs: `python -m plugins.gphoto2.worker FD` answers requests on a socket.

A fault in the library, or in a camera's driver of it, ends this process and not the controller. A call that hangs ends
with it, too: the controller kills it. Requests and answers are those of ``plugins.library_process``.
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from hal.codecs.ptp.values import broken, printable
from hal.errors import DeviceError, DeviceGone, DeviceRefused, DeviceTimeout
from hal.values import CameraCapabilities, CameraStatus, CapturedFile, DeviceIdentity, ExposureSettings
from plugins.camera_files import PendingFile, commit_all, kind_of
from plugins.gphoto2 import library as words
from plugins.gphoto2.library import load_library, translated
from plugins.library_process import DeviceWorker, served, shot_lost
from plugins.ptp.body import LARGEST_PICTURE, nearest, no_such_file

_LOW_BATTERY: Final = 25
_LITTLE_SPACE: Final = 1 << 30


class Opened:
    """A camera opened by the library, and its settings. Only for the worker's thread."""

    def __init__(self, library: Any, camera: Any) -> None:
        self.library = library
        self.camera = camera
        names = {widget: _named(camera, library, group) for widget, group in _GROUPS.items()}
        self.names: dict[str, str] = {kind: name for kind, name in names.items() if name}

    def text(self, name: str) -> str:
        """A widget's value; "" if there is none."""
        try:
            return printable(str(self.camera.get_single_config(name).get_value()))
        except self.library.GPhoto2Error:
            return ""

    def close(self) -> None:
        with contextlib.suppress(self.library.GPhoto2Error):
            self.camera.exit()

    def choices(self, kind: str) -> list[str]:
        if kind not in self.names:
            return []
        widget = self.camera.get_single_config(self.names[kind])
        return [] if widget.get_readonly() else [widget.get_choice(at) for at in range(widget.count_choices())]

    def numbers(self, kind: str) -> dict[float, str]:
        """The numbers of a setting, and their texts."""
        read = _READERS[kind]
        return {number: choice for choice in self.choices(kind) if (number := read(choice)) is not None}

    def set(self, kind: str, choice: str) -> str:
        """Set a widget unless it has the value already, and read it back."""
        name = self.names[kind]
        widget = self.camera.get_single_config(name)
        if widget.get_value() != choice:
            widget.set_value(choice)
            self.camera.set_single_config(name, widget)
        return str(self.camera.get_single_config(name).get_value())


_GROUPS: Final = {"shutter": words.SHUTTER, "iso": words.ISO, "aperture": words.APERTURE, "format": words.FORMAT}
_READERS: Final[Mapping[str, Callable[[str], float | None]]] = {
    "shutter": words.seconds,
    "iso": words.iso,
    "aperture": words.f_number,
}


def fetched(opened: Opened, found: Sequence[tuple[str, str]], destination: Path) -> list[CapturedFile]:
    """All files of a picture; the library holds one of them in memory at a time."""
    with contextlib.ExitStack() as temporary:
        pending = []
        for folder, name in found:
            kind = kind_of(0, name)
            if kind is None:
                continue
            path = destination.parent / f"{destination.name}{kind[1]}"
            file = temporary.enter_context(PendingFile(path, kind[0]))
            held = opened.camera.file_get(folder, name, opened.library.GP_FILE_TYPE_NORMAL)
            data = held.get_data_and_size()  # a view, valid as long as ``held`` exists
            if not 0 < len(data) <= LARGEST_PICTURE:
                raise broken(f"a picture of {len(data)} bytes")
            file.write(memoryview(data).cast("B"))
            pending.append(file)
        return commit_all(pending)


def frame(opened: Opened) -> bytes:
    held = opened.camera.capture_preview()
    return bytes(held.get_data_and_size())


def capabilities(opened: Opened) -> CameraCapabilities:
    can = opened.camera.get_abilities().operations
    formats = opened.choices("format")
    raw = words.pick_format(formats, raw=True) is not None
    return CameraCapabilities(
        exposures_s=tuple(sorted(opened.numbers("shutter"))),
        isos=tuple(sorted(round(iso) for iso in opened.numbers("iso"))),
        apertures_f=tuple(sorted(opened.numbers("aperture"))),
        raw=raw,
        jpeg=not formats or words.pick_format(formats, raw=False) is not None,
        live_view=bool(can & opened.library.GP_OPERATION_CAPTURE_PREVIEW),
    )


def identity(opened: Opened) -> DeviceIdentity:
    model = opened.text("cameramodel") or printable(opened.camera.get_abilities().model)
    return DeviceIdentity(opened.text("manufacturer"), model, opened.text("serialnumber"), opened.text("deviceversion"))


def configure(opened: Opened, settings: ExposureSettings) -> ExposureSettings:
    formats = opened.choices("format")
    wanted = words.pick_format(formats, raw=settings.raw)
    if (formats or settings.raw) and wanted is None:
        raise no_such_file(settings.raw)
    shutters, isos, apertures = opened.numbers("shutter"), opened.numbers("iso"), opened.numbers("aperture")
    exposure_s = nearest(shutters, settings.exposure_s, setting="exposure time in seconds")
    iso = nearest(isos, settings.iso, setting="ISO speed") if isos else settings.iso
    aperture_f = settings.aperture_f
    if aperture_f is not None:
        aperture_f = nearest(apertures, aperture_f, setting="aperture")
        aperture_f = words.f_number(opened.set("aperture", apertures[aperture_f])) or aperture_f
    if wanted is not None:
        opened.set("format", wanted)
    exposure_s = words.seconds(opened.set("shutter", shutters[exposure_s])) or exposure_s
    if isos:
        iso = words.iso(opened.set("iso", isos[iso])) or iso
    return ExposureSettings(exposure_s, round(iso), aperture_f, settings.raw)


def status(opened: Opened) -> CameraStatus:
    battery = words.percent(opened.text("batterylevel"))
    stores = opened.camera.get_storageinfo()
    free = sum(store.freekbytes for store in stores) * 1024 if stores else None
    warnings = ["battery-low"] * (battery is not None and battery <= _LOW_BATTERY)
    warnings += ["card-nearly-full"] * (free is not None and free < min(_LITTLE_SPACE, LARGEST_PICTURE) // 8)
    return CameraStatus(battery, free, sum(store.freeimages for store in stores) if stores else None, tuple(warnings))


def _named(camera: Any, library: Any, names: Sequence[str]) -> str:
    """The first widget of ``names`` that this camera has."""
    for name in names:
        with contextlib.suppress(library.GPhoto2Error):
            camera.get_single_config(name)
            return name
    return ""


def children(widget: Any) -> list[Any]:
    below = [widget.get_child(at) for at in range(widget.count_children())]
    return below + [deeper for child in below for deeper in children(child)]


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
        return capabilities(self._open())

    def identity(self) -> DeviceIdentity:
        return identity(self._open())

    def status(self) -> CameraStatus:
        return status(self._open())

    def configure(self, settings: ExposureSettings) -> ExposureSettings:
        return configure(self._open(), settings)

    def live_view(self) -> bytes:
        return frame(self._open())

    def end_live_view(self) -> None:
        opened = self._open()
        if "viewfinder" in {child.get_name() for child in children(opened.camera.get_config())}:
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
        captured = fetched(opened, found, destination)
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
