"""A projector's calibration after it has turned: where all lies now follows from the homography, without new codes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from controller.core import channels
from controller.core.arrays import Float64, FloatImage
from controller.optics.calibrate.values import Radiometry

ON_PROJECTOR: Final = ("projector_px", "shown_px")
"""Arrays with positions on the projector: the correspondences, and the phase map of the light transport."""
Arrays = Mapping[str, npt.NDArray[Any]]


def update_positions(arrays: Arrays, matrix: Float64) -> dict[str, npt.NDArray[Any]]:
    """Correspondences and metapixels, as a run keeps them, of a projector whose picture moved by a homography.

    Parameters
    ----------
    arrays : ``ON_PROJECTOR`` (camera rows, columns, 2) are mapped, and whatever is kept by projector pixel (the shape
        of ``centre_px``) is taken from where that pixel's light fell before; the rest stays as it is
    matrix : (3, 3), as ``registration.Motion.matrix``: from where a point lay in the projector's image to where it lies
    """
    rows, columns = arrays["centre_px"].shape[:2]
    back = np.linalg.inv(matrix)
    x, y = np.meshgrid(np.arange(columns, dtype=np.float64), np.arange(rows, dtype=np.float64))
    before = _mapped(np.asarray(back, np.float64), np.stack([x, y], axis=2))
    found = {}
    for name, array in arrays.items():
        if name in ON_PROJECTOR:
            found[name] = _mapped(matrix, array.astype(np.float64)).astype(array.dtype)
        elif array.shape[:2] == (rows, columns):
            found[name] = _taken(array, before, extend=name == "centre_px")
        else:
            found[name] = array
    if "valid" in found:
        known = channels.finite(found["centre_px"])
        found["valid"] = found["valid"] & known
    return found


def _mapped(matrix: Float64, at: Float64) -> Float64:
    below = at @ matrix[2, :2] + matrix[2, 2]
    return np.stack([(at @ matrix[row, :2] + matrix[row, 2]) / below for row in (0, 1)], axis=-1)


def _taken(array: npt.NDArray[Any], at: Float64, *, extend: bool) -> npt.NDArray[Any]:
    """``array`` at places (rows, columns, 2); beyond its border the border's, or its straight continuation."""
    rows, columns = array.shape[:2]
    inside = np.clip(at, 0, [columns - 1, rows - 1])
    if array.dtype == np.bool_:
        column, row = (np.rint(inside[:, :, axis]).astype(np.int64) for axis in (0, 1))
        return np.asarray(array[row, column])
    image = np.asarray(array, np.float32)
    taken = _sampled(image, inside)
    if extend:
        # Slopes two pixels off the border: at it, they may be cut short.
        inner = np.clip(at, 2, [columns - 3, rows - 3])
        for axis, beyond in ((1, at[:, :, 0] - inside[:, :, 0]), (0, at[:, :, 1] - inside[:, :, 1])):
            slope = _sampled(np.asarray(np.gradient(image, axis=axis), np.float32), inner)
            taken += np.where(beyond[:, :, None] != 0, slope * beyond[:, :, None], 0).astype(np.float32)
    return taken.astype(array.dtype)


def _sampled(image: FloatImage, at: Float64) -> FloatImage:
    # OpenCV would round the places to a 32nd of a pixel, which is too coarse for centres.
    from scipy.ndimage import map_coordinates

    places = [at[:, :, 1], at[:, :, 0]]
    channels = [map_coordinates(image[:, :, c], places, order=1, mode="nearest") for c in range(image.shape[2])]
    return np.stack(channels, axis=2).astype(np.float32)


def update_radiometry(radiometry: Radiometry, gain: tuple[float, float, float]) -> Radiometry:
    """The radiometry of a projector whose channels have changed in strength; the white image has to follow.

    White light of camera channel c is now sum_k mixing[c, k] gain[k] times what it was.
    """
    mixing, paint = radiometry.mixing * np.asarray(gain), radiometry.paint
    if paint is not None:
        paint = paint * np.asarray(gain)[:, None]
        # White has changed, too, and paint is told by it.
        paint = paint @ np.linalg.inv(paint.sum(axis=1))
    return replace(radiometry, mixing=mixing / mixing.sum(axis=1, keepdims=True), paint=paint)
