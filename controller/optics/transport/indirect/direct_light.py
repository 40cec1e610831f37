"""Kernels that find the direct light of a picture whose indirect light is known in blocks (``IndirectLight``)."""

from __future__ import annotations

import numpy as np
from numba import prange

from controller.core.arrays import FloatImage, Mask
from controller.core.jit import compiled
from controller.optics.transport.indirect.blocks import between, mixed


@compiled(parallel=True)
def approach(
    direct: FloatImage,
    total: FloatImage,
    scale: FloatImage,
    lit: Mask,
    blocks: FloatImage,
    side: int,
    spread: FloatImage,
    unpainted: FloatImage,
    first: int,
) -> FloatImage:
    """Let ``direct`` (rows, columns, 3) be what is left of ``total`` beside other light; 0 where it is not ``lit``.

    ``scale``, ``lit``: of ``IndirectLight``; ``blocks`` (rows of blocks, columns of blocks, 3): light that falls on
    blocks of ``side`` pixels; ``spread`` like ``direct``: light that comes out beside where it fell; none with 0 rows;
    ``unpainted`` (3, 3, rows, columns): what is added of each channel to another; none with 0 rows
    ``first``: row of the picture with which all of these but ``blocks`` begin

    Returns the largest change of a number in each row (rows,).
    """
    rows, columns = lit.shape
    changed = np.zeros(rows, np.float32)
    for y in prange(rows):
        above, below, down_share = between(first + y, side, blocks.shape[0])
        largest = np.float32(0)
        left = np.zeros(3, np.float32)
        for x in range(columns):
            for c in range(3):
                left[c] = 0
            if lit[y, x]:
                before, after, share = between(x, side, blocks.shape[1])
                for c in range(3):
                    upper = mixed(blocks[above, before, c], blocks[above, after, c], share)
                    lower = mixed(blocks[below, before, c], blocks[below, after, c], share)
                    left[c] = total[y, x, c] - scale[y, x, c] * mixed(upper, lower, down_share)
                    if spread.shape[0]:
                        left[c] -= spread[y, x, c]
            for c in range(3):
                found = left[c]
                if unpainted.shape[2]:
                    for other in range(3):
                        found += unpainted[c, other, y, x] * left[other]
                largest = max(largest, abs(found - direct[y, x, c]))
                direct[y, x, c] = found
        changed[y] = largest
    return changed


@compiled(parallel=True)
def displayable_sums(direct: FloatImage, reach: FloatImage, rows: int, columns: int, side: int) -> FloatImage:
    """(rows of blocks, columns of blocks, 3): sums of what can be shown of ``direct`` (rows, columns, 3).

    That is no less than none, and no more than ``reach`` like ``direct``; without an upper limit if that has 0 rows.
    """
    height, width, channels = direct.shape
    out = np.zeros((rows, columns, channels), np.float32)
    for row in prange(rows):
        for y in range(row * side, min(row * side + side, height)):
            for column in range(columns):
                for c in range(channels):
                    part = np.float32(0)
                    for x in range(column * side, min(column * side + side, width)):
                        shown = max(direct[y, x, c], np.float32(0))
                        part += min(shown, reach[y, x, c]) if reach.shape[0] else shown
                    out[row, column, c] += part
    return out
