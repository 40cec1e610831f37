"""The captures of one projector as the numeric steps take them: a mapping from a pattern's name to its photograph.

The mapping may load each photograph when it is asked for: every step asks once for each, so that a large stage need
never lie in memory as a whole. All photographs are linear, in one common unit (full scale at one exposure, or per
second), and hold NaN where they were saturated or not measured.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, TypeAlias

import cv2
import numpy as np

from controller.core.arrays import FloatImage, Mask
from controller.core.channels import every, finite
from controller.core.errors import CalibrationError

Captures: TypeAlias = Mapping[str, FloatImage]


def coloured(captures: Captures, name: str, shape: tuple[int, ...] | None = None) -> FloatImage:
    """The photograph of one pattern, checked against the ``shape`` (rows, columns) of the others.

    Raises CalibrationError("capture-missing") or CalibrationError("capture-shape-wrong").
    """
    try:
        image = captures[name]
    except KeyError:
        raise CalibrationError(
            "capture-missing",
            what=f"The photograph of pattern {name} is missing.",
            remedy="Start the calibration again; it takes only the missing photographs.",
        ) from None
    if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3) or shape not in (None, image.shape[:2]):
        raise CalibrationError(
            "capture-shape-wrong",
            what=f"The photograph of pattern {name} has the shape {image.shape}, unlike the others.",
            remedy="Do not change the camera's picture size during a calibration, and take the photographs again.",
        )
    return np.ascontiguousarray(image, dtype=np.float32)


def grey(captures: Captures, name: str, shape: tuple[int, ...] | None = None) -> FloatImage:
    """As ``coloured``, the channels added up: (rows, columns) float32. Patterns that are grey lose nothing by this."""
    image = coloured(captures, name, shape)
    if image.ndim == 2:
        return image
    return np.asarray(cv2.transform(image, np.ones((1, 3), np.float32)), np.float32).reshape(image.shape[:2])


LIT_SHARE: Final = 0.05
"""Of the 99th percentile of white: darker camera pixels add noise and stray light."""


def lit_pixels(white: FloatImage) -> Mask:
    """(rows, columns): where white (rows, columns, 3), less black, is known and bright in every channel."""
    known: Mask = finite(white)
    if not known.any():
        return known
    bright = np.percentile(white.reshape(-1, 3)[np.flatnonzero(known)[::7]], 99, axis=0)
    return np.asarray(known & every(white > LIT_SHARE * bright) & np.all(bright > 0))
