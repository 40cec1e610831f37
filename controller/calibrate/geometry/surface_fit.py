"""Points on the object's surface from noisy inverse depths: a curved patch through each neighbourhood.

A plane would shave the object's curvature off: on the emulated stage planes of 7 pixels cost 0.3 mm, where the
measurement itself is good to 0.05 mm.
"""

from __future__ import annotations

from typing import Final

import cv2
import numba
import numpy as np

from controller.core.arrays import Float64, FloatImage, Mask
from controller.core.jit import compiled

SAME_SURFACE: Final = 0.02
"""Relative step of inverse depth beyond which a neighbour lies on another surface."""
STEEPEST: Final = 10.0
"""Relative step of inverse depth over two pixels, in pixel widths: beyond it (79 degrees from head-on) both pixels may
see two surfaces at once."""
TERMS: Final = 6


def whole_pixels(inverse: FloatImage, focal_px: float) -> Mask:
    """(rows, columns): neither the pixel nor any of the eight around it sees an edge of the object.

    A pixel at an edge mixes two surfaces, and optics and colour pattern carry that on to the next. A single wrong or
    missing pixel is not an edge, but not whole either. ``inverse`` (rows, columns) float32 is NaN where unknown.
    """
    square, step = np.ones((3, 3), np.uint8), STEEPEST / focal_px
    filled = np.where(np.isfinite(inverse), inverse, np.float32(0))
    steady = cv2.medianBlur(filled, 3)
    edge = cv2.dilate(steady, square) - cv2.erode(steady, square) > step * steady
    whole = cv2.dilate(edge.astype(np.uint8), square) == 0
    return np.asarray(whole & (filled > 0) & (np.abs(filled - steady) <= step * filled))


@compiled(parallel=True)
def fit_patches(inverse: FloatImage, whole: Mask, radius: int) -> FloatImage:
    """Fit a polynomial of second degree to the inverse depths around each pixel, robustly, within one surface.

    Parameters
    ----------
    inverse : (rows, columns) float32, NaN where unknown
    whole : (rows, columns) bool, the pixels to fit to (``whole_pixels``); the others are only replaced by the fit
    radius : the neighbourhood is (2 radius + 1) pixels square, at least 2

    Returns
    -------
    (rows, columns) float32: the patch's value at each pixel; NaN where fewer than twelve whole pixels of its surface
    are in reach or its own value is far off the patch
    """
    rows, columns = inverse.shape
    smooth = np.full((rows, columns), np.nan, dtype=np.float32)
    for row in numba.prange(rows):
        matrix, right, terms = np.empty((TERMS, TERMS)), np.empty(TERMS), np.empty(TERMS)
        for column in range(columns):
            if inverse[row, column] > 0.0:
                smooth[row, column] = _patch_at(inverse, whole, radius, row, column, matrix, right, terms)
    return smooth


@compiled()
def _patch_at(
    inverse: FloatImage,
    whole: Mask,
    radius: int,
    row: int,
    column: int,
    matrix: Float64,
    right: Float64,
    terms: Float64,
) -> float:
    """The patch's value at one pixel, or NaN; ``matrix``, ``right`` and ``terms`` are room to work in."""
    here = inverse[row, column]
    spread = -1.0
    for _ in range(2):
        count = _equations(inverse, whole, radius, row, column, spread, matrix, right, terms)
        if count < 2 * TERMS or not _solve(matrix, right):
            return np.nan
        spread = _spread(inverse, whole, radius, row, column, right, terms)
    if not right[0] > -here or abs(right[0]) > 5.0 * np.sqrt(spread) + 1e-6 * here:
        return np.nan
    return float(here + right[0])


@compiled()
def _describe(dx: float, dy: float, terms: Float64) -> None:
    terms[0], terms[1], terms[2], terms[3], terms[4], terms[5] = 1.0, dx, dy, dx * dx, dx * dy, dy * dy


@compiled()
def _equations(
    inverse: FloatImage,
    whole: Mask,
    radius: int,
    row: int,
    column: int,
    spread: float,
    matrix: Float64,
    right: Float64,
    terms: Float64,
) -> int:
    """Normal equations of the patch; neighbours far from the patch in ``right`` count less, if ``spread`` is not < 0.

    Returns the number of neighbours; ``right`` holds the patch before, and the equations' right side after.
    """
    rows, columns = inverse.shape
    here, old = inverse[row, column], right.copy()
    matrix[:], right[:] = 0.0, 0.0
    count = 0
    for i in range(max(0, row - radius), min(rows, row + radius + 1)):
        for j in range(max(0, column - radius), min(columns, column + radius + 1)):
            value = inverse[i, j] - here
            if not whole[i, j] or not abs(value) < SAME_SURFACE * here:
                continue
            _describe((j - column) / radius, (i - row) / radius, terms)
            weight = 1.0
            if spread >= 0.0:
                off = value
                for k in range(TERMS):
                    off -= old[k] * terms[k]
                weight = 1.0 / (1.0 + off * off / (4.0 * spread + 1e-20))
            count += 1
            for k in range(TERMS):
                scaled = weight * terms[k]
                right[k] += scaled * value
                for m in range(k + 1):
                    matrix[k, m] += scaled * terms[m]
    return count


@compiled()
def _spread(
    inverse: FloatImage, whole: Mask, radius: int, row: int, column: int, patch: Float64, terms: Float64
) -> float:
    """Mean squared distance of the neighbours from a patch."""
    rows, columns = inverse.shape
    here = inverse[row, column]
    squares, count = 0.0, 0
    for i in range(max(0, row - radius), min(rows, row + radius + 1)):
        for j in range(max(0, column - radius), min(columns, column + radius + 1)):
            off = inverse[i, j] - here
            if not whole[i, j] or not abs(off) < SAME_SURFACE * here:
                continue
            _describe((j - column) / radius, (i - row) / radius, terms)
            for k in range(TERMS):
                off -= patch[k] * terms[k]
            squares += off * off
            count += 1
    return squares / max(count, 1)


@compiled()
def _solve(matrix: Float64, right: Float64) -> bool:
    """Solve in place by Cholesky from the lower half; False where the neighbours do not fix a patch."""
    for i in range(TERMS):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            if i == j:
                if not total > 1e-4:
                    return False
                matrix[i, i] = np.sqrt(total)
            else:
                matrix[i, j] = total / matrix[j, j]
    for i in range(TERMS):
        for k in range(i):
            right[i] -= matrix[i, k] * right[k]
        right[i] /= matrix[i, i]
    for i in range(TERMS - 1, -1, -1):
        for k in range(i + 1, TERMS):
            right[i] -= matrix[k, i] * right[k]
        right[i] /= matrix[i, i]
    return True
