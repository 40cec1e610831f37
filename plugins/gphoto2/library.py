"""libgphoto2 through its wheel: loads it, converts its errors, and reads its widgets' values as numbers.

The choices of a widget are texts, and differ by camera.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from typing import Any, Final

from hal.codecs.ptp.values import printable
from hal.errors import DeviceBusy, DeviceError, DeviceGone, DeviceRefused, DeviceTimeout, PluginError


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


def translated(library: Any, error: Exception) -> DeviceError:
    code: int = getattr(error, "code", library.GP_ERROR)
    said = printable(str(error))
    if code in (library.GP_ERROR_CAMERA_BUSY, library.GP_ERROR_IO_USB_CLAIM, library.GP_ERROR_IO_LOCK):
        return DeviceBusy(
            "camera-in-use",
            what=f"The camera is busy, or another program holds it ({said}).",
            remedy="Close photo programs and the desktop's file manager (gvfs-gphoto2-volume-monitor), then try again.",
        )
    if code == library.GP_ERROR_TIMEOUT:
        return DeviceTimeout(
            "camera-no-answer",
            what="The camera did not answer libgphoto2 in time.",
            remedy="Check that it is awake. If it does not answer, switch it off and on.",
        )
    if code in (library.GP_ERROR_MODEL_NOT_FOUND, library.GP_ERROR_UNKNOWN_PORT) or -60 <= code <= -50 or code == -7:
        return DeviceGone(
            "camera-disconnected",
            what=f"libgphoto2 has lost the camera ({said}).",
            remedy="Check the cable and the battery, and switch automatic power-off off.",
        )
    return DeviceRefused(
        "camera-refused",
        what=f"The camera refused a command of libgphoto2 ({said}).",
        remedy="Check the mode dial (M), the lens switch (manual focus) and the card, then try again.",
    )


SHUTTER: Final = ("shutterspeed", "shutterspeed2", "exptime")
ISO: Final = ("iso", "isospeed")
APERTURE: Final = ("aperture", "f-number")
FORMAT: Final = ("imageformat", "imagequality")
_LONGEST: Final = 64
_SECONDS: Final = re.compile(r"([0-9]+(?:\.[0-9]+)?)(?:/([0-9]+(?:\.[0-9]+)?))? ?s?", re.ASCII)
_F_NUMBER: Final = re.compile(r"(?:f/?)? ?([0-9]+(?:\.[0-9]+)?)", re.IGNORECASE | re.ASCII)
_WHOLE: Final = re.compile(r"(?:ISO ?)?([0-9]{1,7})", re.IGNORECASE | re.ASCII)


def seconds(choice: str) -> float | None:
    """Seconds of ``1/60``, ``0.0200s``, ``30``; None for bulb, auto and the like."""
    match = _SECONDS.fullmatch(choice[:_LONGEST])
    if match is None:
        return None
    below = float(match[2] or 1)
    return _sensible(float(match[1]) / below if below else 0.0)


def f_number(choice: str) -> float | None:
    """The number of ``f/5.6`` or ``5.6``."""
    match = _F_NUMBER.fullmatch(choice[:_LONGEST])
    return _sensible(float(match[1])) if match else None


def iso(choice: str) -> float | None:
    """The speed of ``100`` or ``ISO 100``; None for auto."""
    match = _WHOLE.fullmatch(choice[:_LONGEST])
    return _sensible(float(match[1])) if match else None


def percent(text: str) -> int | None:
    """``50%`` as 50."""
    match = re.fullmatch(r"([0-9]{1,3}) ?%", text[:_LONGEST], re.ASCII)
    return min(100, int(match[1])) if match else None


def pick_format(choices: Iterable[str], *, raw: bool) -> str | None:
    """The choice for a RAW file alone, or with a JPEG where there is no other; or for the first, largest JPEG."""
    names = [choice for choice in choices if _is_raw(choice) == raw]
    alone = [choice for choice in names if not (raw and re.search(r"\+|jpe?g", choice, re.IGNORECASE))]
    return next(iter(alone or names), None)


def _is_raw(choice: str) -> bool:
    return re.search(r"raw|nef|arw|raf|orf|cr[23w]|dng", choice, re.IGNORECASE) is not None


def _sensible(value: float) -> float | None:
    return value if math.isfinite(value) and 0 < value < 1e7 else None
