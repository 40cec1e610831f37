"""Linear light to a projector's 8-bit device values."""

from __future__ import annotations

import numpy as np
from numba import prange

from controller.core.arrays import ByteImage, Float64, FloatImage
from controller.core.errors import UsageError
from controller.core.jit import compiled


def encode_frame(linear: FloatImage, response: Float64, *, dither: bool = True) -> ByteImage:
    """Device values whose light is closest to ``linear``.

    Parameters
    ----------
    linear : (rows, columns, 3) float32, clipped to [0, 1]; NaN counts as 0
    response : (3, 256) light of each device value, not falling, 0 at black, 1 at white
    dither : pass each pixel's rounding error on to its neighbours (Floyd and Steinberg 1976, rows in alternating
        direction, errors in linear light), so that areas keep their mean; the same input gives the same output

    Raises UsageError("frame-shape-wrong") or UsageError("response-not-rising").
    """
    if linear.ndim != 3 or linear.shape[2] != 3:
        raise UsageError(
            "frame-shape-wrong",
            what=f"A frame must have the shape (rows, columns, 3), but this one has {linear.shape}.",
            remedy="Give one linear RGB image of the projector's size.",
        )
    table = checked_response(response)
    device = np.empty(linear.shape, np.uint8)
    _quantise(np.ascontiguousarray(linear, dtype=np.float32), table, dither, device)
    return device


def checked_response(response: Float64) -> FloatImage:
    """The table (3, 256) as the kernels take it. Raises UsageError("response-not-rising")."""
    table = np.ascontiguousarray(response, dtype=np.float32)
    if table.shape != (3, 256) or not np.all(np.isfinite(table)) or np.any(np.diff(table, axis=1) < 0):
        raise UsageError(
            "response-not-rising",
            what="The projector's response table must have 3 rows of 256 rising values.",
            remedy="Measure the projector's response again.",
        )
    return table


@compiled()
def _nearest(table: FloatImage, light: float) -> int:
    low, high = 0, 255
    while high - low > 1:
        middle = (low + high) // 2
        if table[middle] <= light:
            low = middle
        else:
            high = middle
    return low if light - table[low] <= table[high] - light else high


@compiled()
def _quantise_row(
    wanted: FloatImage, table: FloatImage, step: int, dither: bool, here: FloatImage, below: FloatImage, row: ByteImage
) -> None:
    """One row of one channel; ``here`` and ``below`` hold the errors passed on to this row and the next."""
    columns = wanted.size
    for index in range(columns):
        column = index if step == 1 else columns - 1 - index
        value = wanted[column]
        value = min(max(value, np.float32(0)), np.float32(1)) if value >= 0 else np.float32(0)  # NaN is not
        light = value + here[column + 1]
        nearest = _nearest(table, light)
        row[column] = nearest
        if dither and 0.0 < value < 1.0:
            error = light - table[nearest]
            here[column + 1 + step] += error * np.float32(7 / 16)
            below[column + 1 - step] += error * np.float32(3 / 16)
            below[column + 1] += error * np.float32(5 / 16)
            below[column + 1 + step] += error * np.float32(1 / 16)


@compiled(parallel=True)
def _quantise(linear: FloatImage, response: FloatImage, dither: bool, device: ByteImage) -> None:
    rows, columns, channels = linear.shape
    for channel in prange(channels):
        # one column more at both sides takes the errors that fall off the frame
        errors = np.zeros((2, columns + 2), np.float32)
        for y in range(rows):
            step = 1 if y % 2 == 0 else -1
            here, below = errors[y % 2], errors[1 - y % 2]
            below[:] = 0
            _quantise_row(linear[y, :, channel], response[channel], step, dither, here, below, device[y, :, channel])
