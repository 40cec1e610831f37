"""What passes between an emulated camera's shutter and whatever makes its pictures (the optical bench, or a test)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ShotSettings:
    """One exposure: seconds, ISO speed, f-number, and which files are wanted."""

    exposure_s: float
    iso: int
    aperture_f: float
    raw: bool
    jpeg: bool


@dataclass(frozen=True, slots=True)
class ShotFiles:
    """The files of one exposure, whole: ``raw`` a DNG, ``jpeg`` a JPEG; None where not wanted."""

    raw: bytes | None
    jpeg: bytes | None


Expose = Callable[[ShotSettings], ShotFiles]
"""Makes the files; called once for each exposure, when the shutter has closed, from the camera's own thread."""
