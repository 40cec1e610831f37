"""Exposure values of libgphoto2's widgets as numbers; their choices are texts and differ by camera."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from typing import Final

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
