"""A camera's focal length in pixels from what its photographs tell of themselves (EXIF 2.32): the fallback."""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import Final

import numpy as np
from PIL import Image, UnidentifiedImageError

from controller.core.errors import CalibrationError, WorkError
from controller.core.files import require_regular
from controller.optics.calibrate.camera.intrinsics import CameraIntrinsics

FOCAL_REL_SIGMA: Final = 0.03
"""Lenses report whole millimetres, and their focal length changes with focus."""
CENTRE_SHARE: Final = 0.005
K1_SIGMA: Final = 0.05
FULL_FRAME_DIAGONAL_MM: Final = 43.267
_EXIF, _FOCAL_MM, _FOCAL_35MM, _WIDTH, _HEIGHT = 0x8769, 0x920A, 0xA405, 0xA002, 0xA003
_PLANE_X, _PLANE_UNIT = 0xA20E, 0xA210
_MM_PER_UNIT: Final = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}


def intrinsics_from_exif(path: Path) -> CameraIntrinsics:
    """Read a JPEG, a TIFF or a RAW file built on TIFF (CR2, NEF, ARW, DNG).

    Raises WorkError("photograph-unreadable"), CalibrationError("camera-focal-length-unknown").
    """
    try:
        require_regular(path)
        with warnings.catch_warnings(), Image.open(path) as picture:
            # No pixel of it is decoded, so however many it has does no harm.
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            tags = dict(picture.getexif().get_ifd(_EXIF))
            size = picture.size
    except (OSError, UnidentifiedImageError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise WorkError(
            "photograph-unreadable",
            what=f"{path.name} has unreadable EXIF data.",
            remedy="Give a JPEG or RAW file as it came from the camera.",
        ) from error
    width, height = _number(tags.get(_WIDTH)) or size[0], _number(tags.get(_HEIGHT)) or size[1]
    focal_px = _focal_px(tags, math.hypot(width, height))
    if focal_px is None:
        raise CalibrationError(
            "camera-focal-length-unknown",
            what=f"{path.name} does not contain both the focal length and the sensor's size.",
            remedy="Photograph the board of `velatura camera board`, or give focal_length_px in stage.toml.",
        )
    sigmas = np.array([FOCAL_REL_SIGMA, CENTRE_SHARE * width, CENTRE_SHARE * width, K1_SIGMA])
    return CameraIntrinsics(
        size_px=(int(width), int(height)),
        focal_px=focal_px,
        centre_px=((width - 1) / 2, (height - 1) / 2),
        k1=0.0,
        covariance=np.diag(sigmas**2),
        method="exif",
        views=1,
    )


def _focal_px(tags: dict[int, object], diagonal_px: float) -> float | None:
    focal_mm, per_unit = _number(tags.get(_FOCAL_MM)), _number(tags.get(_PLANE_X))
    unit = _number(tags.get(_PLANE_UNIT)) or 2.0
    if focal_mm and per_unit and unit in _MM_PER_UNIT:
        return focal_mm * per_unit / _MM_PER_UNIT[int(unit)]
    focal_35mm = _number(tags.get(_FOCAL_35MM))
    return None if focal_35mm is None else focal_35mm / FULL_FRAME_DIAGONAL_MM * diagonal_px


def _number(value: object) -> float | None:
    """A number above 0, or None; rational tags with a denominator of 0 are not numbers."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if 0 < number < math.inf else None
