"""Means of a picture's blocks, and values of blocks interpolated to a picture, with their transposes."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from controller.core.arrays import FloatImage, Mask


def down(image: FloatImage, grid: tuple[int, int], side: int) -> FloatImage:
    """(blocks, 3): mean of each block of ``side`` x ``side`` pixels; what lies beyond the picture is 0."""
    first = np.add.reduceat(image, np.arange(0, image.shape[0], side), axis=0)
    sums = np.add.reduceat(first, np.arange(0, image.shape[1], side), axis=1)
    return np.asarray(sums.reshape(grid[0] * grid[1], -1) / np.float32(side * side), np.float32)


def parted(image: FloatImage, lit: Mask, grid: tuple[int, int], side: int) -> tuple[FloatImage, FloatImage]:
    """``down`` of an image's pixels on the object, ``lit`` (rows, columns), and of those on the room."""
    own = down(np.where(lit[..., None], image, np.float32(0)), grid, side)
    return own, down(image, grid, side) - own


def down_adjoint(blocks: FloatImage, grid: tuple[int, int], side: int, shape: tuple[int, ...]) -> FloatImage:
    """The transpose of ``down``: (rows, columns, 3)."""
    whole = np.repeat(np.repeat(blocks.reshape(*grid, -1), side, axis=0), side, axis=1)
    return np.asarray(whole[: shape[0], : shape[1]] / np.float32(side * side), np.float32)


def up(blocks: FloatImage, grid: tuple[int, int], side: int, shape: tuple[int, ...]) -> FloatImage:
    """(rows, columns, 3): values of blocks, interpolated between their middles."""
    # OpenCV's linear enlargement is that of ``_between``, and takes a tenth of the time of its products.
    size_px = (grid[1] * side, grid[0] * side)
    whole = cv2.resize(np.ascontiguousarray(blocks.reshape(*grid, -1)), size_px, interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(whole[: shape[0], : shape[1]], np.float32).reshape(*shape[:2], -1)


def down_up(grid: tuple[int, int], side: int, shape: tuple[int, ...]) -> Callable[[FloatImage], FloatImage]:
    """down(up(blocks)), without the picture of ``shape`` between them; blocks (blocks, 3)."""
    rows, columns = (
        np.add.reduceat(_between(shape[n], grid[n], side), np.arange(0, shape[n], side), axis=0) / np.float32(side)
        for n in (0, 1)
    )

    def across(blocks: FloatImage) -> FloatImage:
        planes = np.moveaxis(blocks.reshape(*grid, -1), 2, 0)
        return np.asarray(np.moveaxis(rows @ planes @ columns.T, 0, 2).reshape(len(blocks), -1), np.float32)

    return across


def up_adjoint(image: FloatImage, grid: tuple[int, int], side: int) -> FloatImage:
    """The transpose of ``up``: (blocks, 3)."""
    down_, across = _between(image.shape[0], grid[0], side), _between(image.shape[1], grid[1], side)
    parts = [down_.T @ image[..., c] @ across for c in range(image.shape[2])]
    return np.asarray(np.stack(parts, axis=2).reshape(grid[0] * grid[1], -1), np.float32)


def _between(pixels: int, blocks: int, side: int) -> FloatImage:
    """(pixels, blocks): linear interpolation, constant beyond the outermost middles."""
    at = np.clip((np.arange(pixels) - (side - 1) / 2) / side, 0, blocks - 1)
    return np.asarray(np.maximum(1 - np.abs(at[:, None] - np.arange(blocks)), 0), np.float32)
