"""Facts about the devices of a running kiosk, the X server's outputs, the newest photograph, and the settings."""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Protocol

from controller.config.models import StageTables
from controller.core.text import printable
from controller.kiosk.changes.inventory import Fact
from controller.kiosk.outputs import Connected
from hal.deadline import Deadline, in_seconds
from hal.errors import CodedError
from hal.interfaces import Device, WatchedCamera
from hal.secret_words import concealed, is_secret
from hal.values import DeviceIdentity

ASK_S: Final = 6.0
_EXIF, _LENS, _FOCAL_MM = 0x8769, 0xA434, 0x920A
_PICTURES: Final = (".jpg", ".jpeg", ".dng", ".cr2", ".nef", ".arw", ".tif", ".tiff")
_ADJUSTED: Final = ("input", "keystone", "lamp mode")

InSeconds = Callable[[float], Deadline]


class Asked(Protocol):
    """An opened projector, as far as it is asked here."""

    def identity(self, *, deadline: Deadline) -> DeviceIdentity: ...
    def adjustments(self, *, deadline: Deadline) -> dict[str, str]: ...


def projector_facts(name: str, projector: Asked | None, deadline: InSeconds = in_seconds) -> Iterator[Fact]:
    """Of one projector; all unknown while it is not open, or does not answer."""
    known = _asked(None if projector is None else projector.identity, deadline)
    model = None if known is None else _joined(known.maker, known.model, known.serial)
    yield Fact("projector", name, model)
    yield Fact("projector firmware", name, None if known is None else printable(known.firmware))
    adjustments = _asked(None if projector is None else projector.adjustments, deadline) or {}
    for kind in _ADJUSTED:
        yield Fact(kind, name, printable(adjustments[kind]) if kind in adjustments else None)


def camera_facts(camera: Device | None, deadline: InSeconds = in_seconds) -> Iterator[Fact]:
    """Body, firmware, and what it complains about; all unknown while it is not open, or does not answer."""
    known = _asked(None if camera is None else camera.identity, deadline)
    yield Fact("camera body", "", None if known is None else _joined(known.maker, known.model, known.serial))
    yield Fact("camera firmware", "", None if known is None else printable(known.firmware))
    if isinstance(camera, WatchedCamera):
        status = _asked(camera.status, deadline)
        said = None if status is None else ", ".join(sorted(status.warnings)) or "none"
        yield Fact("camera settings", "warnings", said)


def lens_facts(stage: Path) -> Iterator[Fact]:
    """Lens data of the newest photograph; unknown where none does."""
    for run in sorted((stage / "runs").glob("*"), reverse=True):
        for picture in sorted((run / "captures").rglob("*"), reverse=True):
            if picture.suffix.lower() not in _PICTURES:
                continue
            tags = _exif(picture)
            if tags.get(_LENS) or tags.get(_FOCAL_MM):
                yield Fact("lens", "", printable(str(tags.get(_LENS) or "unnamed")).strip("\0 "))
                yield Fact("lens", "focal length", f"{mm:g} mm" if (mm := float(tags.get(_FOCAL_MM) or 0)) else None)
                return
            # All of one run come from the same camera.
            break


def _exif(picture: Path) -> dict[int, Any]:
    from PIL import Image, UnidentifiedImageError

    try:
        with warnings.catch_warnings(), Image.open(picture) as opened:
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            return dict(opened.getexif().get_ifd(_EXIF))
    except (OSError, UnidentifiedImageError, ValueError, SyntaxError, Image.DecompressionBombError):
        return {}


def shown_facts(outputs: Sequence[Connected]) -> Iterator[Fact]:
    """Mode and place of each output that the X server shows now."""
    shown = [(one.left_top_px, one) for one in outputs if one.left_top_px is not None]
    for _, one in shown:
        for mode in one.modes:
            if mode.current:
                width_px, height_px, rate_hz = mode.key
                yield Fact("mode", one.name, f"{width_px}x{height_px} at {rate_hz:.1f} Hz")
    for place, ((left, top), one) in enumerate(sorted(shown, key=lambda item: item[0]), 1):
        yield Fact("output order", one.name, f"number {place} from the left, at {left} {top}")


def settings_facts(tables: StageTables) -> Iterator[Fact]:
    """Every value of stage.toml by its key. Passwords and keys are compared, and not kept."""
    for key, value in _flat("", tables.model_dump(mode="json")):
        text = json.dumps(value)
        secret = f"secret {hashlib.sha256(text.encode()).hexdigest()[:8]}"
        yield Fact("settings", key, secret if is_secret(key.rpartition(".")[2]) or concealed(text) != text else text)


def _flat(key: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping):
        for name, one in value.items():
            yield from _flat(f"{key}.{name}" if key else str(name), one)
    elif isinstance(value, list) and value and all(isinstance(one, Mapping) for one in value):
        for number, one in enumerate(value):
            yield from _flat(f"{key} {one.get('name', number + 1)}", one)
    else:
        yield key, value


def _asked(question: Callable[..., Any] | None, deadline: InSeconds) -> Any:
    """The device's answer; None without one."""
    if question is None:
        return None
    try:
        return question(deadline=deadline(ASK_S))
    except CodedError:
        return None


def _joined(*words: str) -> str:
    return printable(" ".join(word for word in words if word))
