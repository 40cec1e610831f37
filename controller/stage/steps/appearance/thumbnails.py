"""Small pictures of appearances as the camera should see them, for the panel and for bundles."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from controller.bundle.describe import png
from controller.core.arrays import ByteImage, Float64, FloatImage
from controller.optics.solve.targets.values import linear_to_srgb
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.projectors import Light
from controller.stage.artefacts.published import read_thumbnail, write_thumbnail
from controller.stage.artefacts.solved import read_solved

LONGEST_PX: Final = 160
_XYZ_TO_SRGB: Final = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])
"""IEC 61966-2-1, linear part."""


class Thumbnails:
    """Makes the thumbnails of a run's appearances, and keeps them in the run's folder until they are solved again.

    The first thumbnail that is not stored yet needs the light transport of ``calibrated``, whose run it is.
    """

    def __init__(self, calibrated: Calibrated) -> None:
        self._calibrated = calibrated
        self._folder, self._projectors = calibrated.folder, calibrated.projectors

    def of(self, name: str) -> bytes | None:
        """The PNG file of a solved appearance of the run; None if its calibration is not in the run."""
        if (kept := read_thumbnail(self._folder, name)) is not None:
            return kept
        if not all(Light.path(self._folder, projector).exists() for projector in self._projectors):
            return None
        data = self._made(name)
        write_thumbnail(self._folder, name, data)
        return data

    def _made(self, name: str) -> bytes:
        calibration = self._calibrated.calibration
        solved = read_solved(self._folder, name, self._projectors)
        seen = self._calibrated.predicted_light([solved.linear[projector] for projector in self._projectors])
        return png(thumbnail(seen + calibration.black, calibration.camera_to_xyz, white=solved.exposure))


def thumbnail(picture: FloatImage, camera_to_xyz: Float64, *, white: float) -> ByteImage:
    """A linear camera picture (rows, columns, 3) as sRGB of at most ``LONGEST_PX`` per side.

    ``white``: the camera value for the screen's white; ``camera_to_xyz`` (3, 3): equal values are D65 grey.
    """
    rows, columns = picture.shape[:2]
    part = min(1.0, LONGEST_PX / max(rows, columns))
    size = max(1, round(columns * part)), max(1, round(rows * part))
    small = np.asarray(cv2.resize(np.nan_to_num(picture), size, interpolation=cv2.INTER_AREA), np.float32)
    matrix = _XYZ_TO_SRGB @ camera_to_xyz
    matrix = (matrix / matrix.sum(axis=1, keepdims=True)).astype(np.float32)
    return np.asarray(np.rint(255 * linear_to_srgb(small @ matrix.T / np.float32(white))), np.uint8)
