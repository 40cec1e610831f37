"""Means of a picture's blocks, and values of blocks interpolated to a picture, with their transposes."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numba import prange

from controller.core.arrays import FloatImage, Mask
from controller.core.jit import compiled


class BlockGrid(NamedTuple):
    """The blocks of camera pictures of ``shape`` (rows, columns, ...).

    ``grid``: (rows, columns) of blocks; ``side``: camera pixels along each
    """

    grid: tuple[int, int]
    side: int
    shape: tuple[int, ...]


def down(image: FloatImage, grid: tuple[int, int], side: int) -> FloatImage:
    """(blocks, 3): mean of each block of ``side`` x ``side`` pixels; what lies beyond the picture is 0."""
    sums = _sums(np.ascontiguousarray(image, np.float32), *grid, side)
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
    out = np.empty((*shape[:2], blocks.shape[1]), np.float32)
    _spread(np.ascontiguousarray(blocks, np.float32).reshape(*grid, -1), side, out)
    return out


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


@compiled(parallel=True)
def _sums(image: FloatImage, rows: int, columns: int, side: int) -> FloatImage:
    """(rows of blocks, columns of blocks, channels): the sum of each block."""
    height, width, channels = image.shape
    out = np.zeros((rows, columns, channels), np.float32)
    for row in prange(rows):
        for y in range(row * side, min(row * side + side, height)):
            for column in range(columns):
                for c in range(channels):
                    # of a row first: one sum over a whole block has ten times the error
                    part = np.float32(0)
                    for x in range(column * side, min(column * side + side, width)):
                        part += image[y, x, c]
                    out[row, column, c] += part
    return out


@compiled()
def between(at_px: int, side: int, blocks: int) -> tuple[int, int, np.float32]:
    """The two blocks between whose middles a pixel lies, and the share of the second; constant beyond the outermost."""
    place = min(max((at_px - 0.5 * (side - 1)) / side, 0.0), blocks - 1.0)
    first = int(place)
    return first, min(first + 1, blocks - 1), np.float32(place - first)


@compiled()
def mixed(first: np.float32, second: np.float32, share: np.float32) -> np.float32:
    """Between the first value and the second: the first with a share of 0."""
    return first + share * (second - first)


@compiled(parallel=True)
def _spread(blocks: FloatImage, side: int, out: FloatImage) -> None:
    """Fill a picture with values of blocks (rows of blocks, columns of blocks, channels)."""
    for y in prange(out.shape[0]):
        above, below, down_share = between(y, side, blocks.shape[0])
        for x in range(out.shape[1]):
            left, right, share = between(x, side, blocks.shape[1])
            for c in range(out.shape[2]):
                upper = mixed(blocks[above, left, c], blocks[above, right, c], share)
                lower = mixed(blocks[below, left, c], blocks[below, right, c], share)
                out[y, x, c] = mixed(upper, lower, down_share)
