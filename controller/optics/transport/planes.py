"""Images (rows, columns, 3), the planes (3, ...) of the products, and rectangles of camera pixels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import prange

from controller.core.arrays import FloatImage
from controller.core.jit import compiled


@compiled(parallel=True)
def _split(pixels: FloatImage, planes: FloatImage) -> None:
    for i in prange(pixels.shape[0]):
        for c in range(3):
            planes[c, i] = pixels[i, c]


@compiled(parallel=True)
def _join(planes: FloatImage, pixels: FloatImage) -> None:
    for i in prange(pixels.shape[0]):
        for c in range(3):
            pixels[i, c] = planes[c, i]


@compiled(parallel=True)
def _split_above(pixels: FloatImage, black: FloatImage, planes: FloatImage) -> None:
    for i in prange(pixels.shape[0]):
        for c in range(3):
            planes[c, i] = max(pixels[i, c] - black[i, c], np.float32(0))


def planes_above(image: npt.NDArray[np.floating], black: npt.NDArray[np.floating]) -> FloatImage:
    """(3, rows, columns) float32 from two finite images (rows, columns, 3): image - black, 0 where it is negative."""
    planes = np.empty((3, *image.shape[:2]), np.float32)
    pixels, dark = (np.ascontiguousarray(part, np.float32).reshape(-1, 3) for part in (image, black))
    _split_above(pixels, dark, planes.reshape(3, -1))
    return planes


def image_planes(image: npt.NDArray[np.floating]) -> FloatImage:
    """(rows, columns, 3) to (3, rows, columns) float32."""
    pixels = np.ascontiguousarray(image, np.float32)
    planes = np.empty((3, *image.shape[:2]), np.float32)
    _split(pixels.reshape(-1, 3), planes.reshape(3, -1))
    return planes


def plane_image(planes: FloatImage) -> FloatImage:
    """(3, rows, columns) to (rows, columns, 3)."""
    image = np.empty((*planes.shape[1:], 3), np.float32)
    _join(np.ascontiguousarray(planes).reshape(3, -1), image.reshape(-1, 3))
    return image


def frame_planes(frames: Sequence[npt.NDArray[np.floating]]) -> FloatImage:
    """One (rows, columns, 3) image a projector to (3, pixels of all projectors)."""
    planes = np.empty((3, sum(frame.shape[0] * frame.shape[1] for frame in frames)), np.float32)
    at = 0
    for frame in frames:
        count = frame.shape[0] * frame.shape[1]
        _split(np.ascontiguousarray(frame, np.float32).reshape(-1, 3), planes[:, at : at + count])
        at += count
    return planes


def plane_frames(planes: FloatImage, sizes: Sequence[tuple[int, int]]) -> list[FloatImage]:
    """(3, pixels of all projectors) to one (rows, columns, 3) image for each of ``sizes``."""
    frames = []
    at = 0
    for rows, columns in sizes:
        frame = np.empty((rows, columns, 3), np.float32)
        _join(planes[:, at : at + rows * columns], frame.reshape(-1, 3))
        frames.append(frame)
        at += rows * columns
    return frames


class CameraBox(NamedTuple):
    """Camera pixels from (top, left) up to, not including, (bottom, right)."""

    top: int
    left: int
    bottom: int
    right: int

    def grown(self, by: int, shape: tuple[int, int]) -> CameraBox:
        """Larger by ``by`` on every side, within an image of ``shape`` (rows, columns)."""
        top, left = max(self.top - by, 0), max(self.left - by, 0)
        return CameraBox(top, left, min(self.bottom + by, shape[0]), min(self.right + by, shape[1]))

    @property
    def window(self) -> tuple[slice, slice]:
        """Rows and columns, as an index of an image."""
        return slice(self.top, self.bottom), slice(self.left, self.right)
