"""A camera opened by libgphoto2, with our values. Only for the thread that opened it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from hal.codecs.ptp.values import broken, printable
from hal.values import CameraCapabilities, CameraStatus, CapturedFile, DeviceIdentity, ExposureSettings
from plugins.gphoto2 import settings as words
from plugins.ptp.body import LARGEST_PICTURE, nearest, no_such_file
from plugins.ptp.files import PendingFile, commit_all, kind_of

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
