"""The driver ``gphoto2``: the cameras that libgphoto2 knows, through the wheel of the same name (extra ``gphoto2``).

For a camera that speaks PTP use the driver ``ptp``: it survives a lost connection in the middle of a picture. This one
never takes a picture twice either, but tells the caller that it was lost.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

from hal.deadline import Deadline
from hal.errors import DeviceBusy, DeviceError, DeviceGone, DeviceRefused, DeviceTimeout, PluginError
from hal.ptp import broken, printable
from hal.registry import Driver, OpenContext
from hal.values import CameraCapabilities, CameraStatus, CapturedFile, DeviceIdentity, ExposureSettings
from plugins import gphoto2_settings as words
from plugins.ptp_body import LARGEST_PICTURE, nearest, no_such_file
from plugins.ptp_files import PendingFile, commit_all, kind_of
from plugins.worker_link import WorkerLink

Result = TypeVar("Result")

_LOW_BATTERY: Final = 25
_LITTLE_SPACE: Final = 1 << 30
_LISTEN_MS: Final = 50
_MOST_FILES: Final = 8


class _Lost(Exception):
    """The library's handle is of no more use."""


class _Opened:
    """A camera that the library has open, and what it can be set to. Only on the worker's thread."""

    def __init__(self, library: Any, camera: Any) -> None:
        self.library = library
        self.camera = camera
        self.lost = False
        names = {widget: _named(camera, library, group) for widget, group in _GROUPS.items()}
        self.names: dict[str, str] = {kind: name for kind, name in names.items() if name}

    def text(self, name: str) -> str:
        """A widget's value; "" where there is none."""
        try:
            return printable(str(self.camera.get_single_config(name).get_value()))
        except self.library.GPhoto2Error:
            return ""

    def choices(self, kind: str) -> list[str]:
        if kind not in self.names:
            return []
        widget = self.camera.get_single_config(self.names[kind])
        return [] if widget.get_readonly() else [widget.get_choice(at) for at in range(widget.count_choices())]

    def numbers(self, kind: str) -> dict[float, str]:
        """The numbers that a setting takes, and their words."""
        read = _READERS[kind]
        return {number: choice for choice in self.choices(kind) if (number := read(choice)) is not None}

    def set(self, kind: str, choice: str) -> str:
        """Set a widget unless it is so, and read it back."""
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


class Gphoto2Camera(WorkerLink[_Opened]):
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
        self._capabilities = self._do(_capabilities, deadline)

    @property
    def capabilities(self) -> CameraCapabilities:
        return self._capabilities

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        return self._do(_identity, deadline)

    def configure(self, settings: ExposureSettings, *, deadline: Deadline) -> ExposureSettings:
        return self._do(lambda opened: _configure(opened, settings), deadline)

    def capture(self, destination: Path, *, deadline: Deadline) -> list[CapturedFile]:
        """See ``hal.interfaces.Camera.capture``. Raises DeviceGone("camera-shot-lost") where the connection broke."""
        return self._do(lambda opened: self._shoot(opened, destination, deadline), deadline, repeatable=False)

    def status(self, *, deadline: Deadline) -> CameraStatus:
        return self._do(_status, deadline)

    def troubles(self) -> list[tuple[str, str]]:
        found, self._troubles = self._troubles, []
        return found

    def live_view(self, *, deadline: Deadline) -> bytes:
        if not self._capabilities.live_view:
            raise DeviceRefused(
                "camera-no-live-view",
                what="The camera can't show what it sees over its cable.",
                remedy="Look through its finder, or take a picture to aim with.",
            )
        return self._do(_frame, deadline)

    def end_live_view(self, *, deadline: Deadline) -> None:
        def end(opened: _Opened) -> None:
            if "viewfinder" in {child.get_name() for child in _children(opened.camera.get_config())}:
                widget = opened.camera.get_single_config("viewfinder")
                widget.set_value(0)
                opened.camera.set_single_config("viewfinder", widget)

        if self._capabilities.live_view:
            self._do(end, deadline)

    def find(self) -> _Opened:
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
                opened = _Opened(self._library, camera)
                serial = opened.text("serialnumber")
            except self._library.GPhoto2Error as error:
                failure = _translated(self._library, error)
                continue
            if not self._serial or serial == self._serial:
                self._serial = serial
                return opened
            self.let_go(opened)
            failure = DeviceRefused(
                "camera-other",
                what=f"The camera that answers is number {serial or '(none)'}, not {self._serial}.",
                remedy="Connect the right camera, or change serial in stage.toml and recalibrate.",
            )
        raise failure

    def let_go(self, opened: _Opened) -> None:
        with contextlib.suppress(self._library.GPhoto2Error):
            opened.camera.exit()

    def _ports(self) -> list[str]:
        """Where to look: the port that was named, then, once the serial number is known, everywhere."""
        named = [self._port] if self._port else []
        found = self._library.Camera.autodetect()
        others = [found.get_value(at) for at in range(found.count())]
        return named + [port for port in others if port != self._port] if self._serial or not named else named

    def _do(self, work: Callable[[_Opened], Result], deadline: Deadline, *, repeatable: bool = True) -> Result:
        """Do ``work`` on the worker; the library's errors become ours, and a lost handle is opened anew."""

        def guarded(opened: _Opened) -> Result:
            if opened.lost:
                raise _Lost
            try:
                return work(opened)
            except self._library.GPhoto2Error as error:
                translated = _translated(self._library, error)
                opened.lost = isinstance(translated, DeviceGone | DeviceTimeout)
                if not opened.lost:
                    raise translated from error
                self._troubles.append((translated.code, translated.what))
                if repeatable:
                    raise _Lost from error
                raise _shot_lost(translated) from error

        return self.call(guarded, deadline=deadline)

    def _shoot(self, opened: _Opened, destination: Path, deadline: Deadline) -> list[CapturedFile]:
        library = self._library
        first = opened.camera.capture(library.GP_CAPTURE_IMAGE)
        found = [(first.folder, first.name)]
        wanted = 2 if "+" in (opened.text(opened.names["format"]) if "format" in opened.names else "") else 1
        while len(found) < wanted and not deadline.passed:
            kind, data = opened.camera.wait_for_event(_LISTEN_MS)
            if kind == library.GP_EVENT_FILE_ADDED and len(found) < _MOST_FILES:
                found.append((data.folder, data.name))
        captured = _fetched(opened, found, destination)
        with contextlib.suppress(library.GPhoto2Error):
            for folder, name in found:
                opened.camera.file_delete(folder, name)
        return captured


def _fetched(opened: _Opened, found: Sequence[tuple[str, str]], destination: Path) -> list[CapturedFile]:
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
            data = held.get_data_and_size()  # a view, good for as long as ``held`` lives
            if not 0 < len(data) <= LARGEST_PICTURE:
                raise broken(f"a picture of {len(data)} bytes")
            file.write(memoryview(data).cast("B"))
            pending.append(file)
        return commit_all(pending)


def _frame(opened: _Opened) -> bytes:
    held = opened.camera.capture_preview()
    return bytes(held.get_data_and_size())


def _capabilities(opened: _Opened) -> CameraCapabilities:
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


def _identity(opened: _Opened) -> DeviceIdentity:
    model = opened.text("cameramodel") or printable(opened.camera.get_abilities().model)
    return DeviceIdentity(opened.text("manufacturer"), model, opened.text("serialnumber"), opened.text("deviceversion"))


def _configure(opened: _Opened, settings: ExposureSettings) -> ExposureSettings:
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


def _status(opened: _Opened) -> CameraStatus:
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


def _children(widget: Any) -> list[Any]:
    below = [widget.get_child(at) for at in range(widget.count_children())]
    return below + [deeper for child in below for deeper in _children(child)]


def _translated(library: Any, error: Exception) -> DeviceError:
    code: int = getattr(error, "code", library.GP_ERROR)
    said = printable(str(error))
    if code in (library.GP_ERROR_CAMERA_BUSY, library.GP_ERROR_IO_USB_CLAIM, library.GP_ERROR_IO_LOCK):
        return DeviceBusy(
            "camera-in-use",
            what=f"The camera is busy, or another program holds it ({said}).",
            remedy="End photo programs and the desktop's file manager (gvfs-gphoto2-volume-monitor), then try again.",
        )
    if code == library.GP_ERROR_TIMEOUT:
        return DeviceTimeout(
            "camera-no-answer",
            what="The camera did not answer libgphoto2 in time.",
            remedy="Check that it is awake; switch it off and on if it stays silent.",
        )
    if code in (library.GP_ERROR_MODEL_NOT_FOUND, library.GP_ERROR_UNKNOWN_PORT) or -60 <= code <= -50 or code == -7:
        return DeviceGone(
            "camera-disconnected",
            what=f"libgphoto2 has lost the camera ({said}).",
            remedy="Check the cable, the battery, and that no automatic power-off is set.",
        )
    return DeviceRefused(
        "camera-refused",
        what=f"The camera refused what libgphoto2 asked of it ({said}).",
        remedy="Check the mode dial (M), the lens switch (manual focus) and the card, then try again.",
    )


def _shot_lost(error: DeviceError) -> DeviceError:
    return DeviceGone(
        "camera-shot-lost",
        what=f"The connection to the camera was lost during a picture: {error.what}",
        remedy="Check cable and battery, then take this picture again; it was not taken twice.",
    )


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
    summary="Cameras that libgphoto2 knows and that do not speak PTP, or not well (needs the extra gphoto2).",
    open=open_camera,
    settings={
        "address": "libgphoto2's port, such as usb:001,004; left out: the first camera that is found",
        "serial": "serial number that the camera must have; left out: whichever answers",
    },
    required=(),
)
