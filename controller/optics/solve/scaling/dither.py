"""From linear light to a projector's 8 bits, through the inverse of its measured response, with dithering.

Dithering chooses between the two device values whose light encloses the wanted light, so that the mean is right in
linear light. Error diffusion (Floyd and Steinberg 1976, serpentine) is the default: seen by the camera it errs less
than thresholds from a blue-noise tile (void and cluster, Ulichney 1993), which are twice as fast. Equal frames give
equal bytes.
"""

from __future__ import annotations

from functools import cache
from typing import Final, Literal

import numpy as np
from numba import prange

from controller.core.arrays import ByteImage, Float64, FloatImage
from controller.core.jit import compiled
from controller.optics.calibrate.values import Radiometry
from controller.optics.capture.encoding import checked_response, encode_frame

Method = Literal["blue-noise", "diffusion", "nearest"]
TILE: Final = 64


def to_device(
    frame: FloatImage, radiometry: Radiometry, *, method: Method = "diffusion", phase: tuple[int, int] = (0, 0)
) -> ByteImage:
    """Device values (rows, columns, 3) uint8 of linear light (rows, columns, 3) in [0, 1]; beyond that it is clipped.

    ``phase``: with blue noise, this projector's offset in its tile; superimposed projectors should have different ones.
    Raises UsageError("response-not-rising", "frame-shape-wrong").
    """
    frame = radiometry.channels(frame)
    if method != "blue-noise":
        return encode_frame(frame, radiometry.response, dither=method == "diffusion")
    light = checked_response(radiometry.response)
    out = np.empty(frame.shape, np.uint8)
    _threshold(np.ascontiguousarray(frame, np.float32), light, blue_noise(), phase[0], phase[1], out)
    return out


def to_light(frame: ByteImage, radiometry: Radiometry) -> FloatImage:
    """Linear light (rows, columns, 3) of device values, by the response and a white segment."""
    light = np.stack([radiometry.response[c][frame[..., c]] for c in range(3)], -1).astype(np.float32)
    return np.asarray(radiometry.emitted(light), np.float32)


@cache
def blue_noise() -> FloatImage:
    """(64, 64) thresholds in (0, 1), each value once, by void and cluster."""
    rng = np.random.default_rng(20)
    d = np.minimum(np.arange(TILE), TILE - np.arange(TILE))
    bump = np.exp(-(d[:, None] ** 2 + d[None] ** 2) / (2 * 1.5**2))
    chosen = np.zeros((TILE, TILE), np.bool_)
    chosen.ravel()[rng.permutation(TILE * TILE)[: TILE * TILE // 10]] = True
    _even_out(chosen, bump)
    rank = np.zeros((TILE, TILE), np.int64)
    start = int(chosen.sum())
    dense, energy = chosen.copy(), _energy(chosen, bump)
    for r in range(start - 1, -1, -1):
        at = _extreme(energy, dense, cluster=True)
        dense[at] = False
        energy -= np.roll(bump, at, (0, 1))
        rank[at] = r
    dense, energy = chosen.copy(), _energy(chosen, bump)
    for r in range(start, TILE * TILE):
        at = _extreme(energy, dense, cluster=False)
        dense[at] = True
        energy += np.roll(bump, at, (0, 1))
        rank[at] = r
    return ((rank + 0.5) / (TILE * TILE)).astype(np.float32)


def _energy(chosen: np.ndarray[tuple[int, ...], np.dtype[np.bool_]], bump: Float64) -> Float64:
    return np.fft.ifft2(np.fft.fft2(chosen) * np.fft.fft2(bump)).real


def _extreme(
    energy: Float64, chosen: np.ndarray[tuple[int, ...], np.dtype[np.bool_]], *, cluster: bool
) -> tuple[int, int]:
    """The chosen pixel with the most company, or the free one with the least."""
    flat = np.where(chosen, energy, -np.inf).argmax() if cluster else np.where(chosen, np.inf, energy).argmin()
    return int(flat) // TILE, int(flat) % TILE


def _even_out(chosen: np.ndarray[tuple[int, ...], np.dtype[np.bool_]], bump: Float64) -> None:
    energy = _energy(chosen, bump)
    for _ in range(TILE * TILE):
        crowded = _extreme(energy, chosen, cluster=True)
        chosen[crowded] = False
        energy -= np.roll(bump, crowded, (0, 1))
        empty = _extreme(energy, chosen, cluster=False)
        chosen[empty] = True
        energy += np.roll(bump, empty, (0, 1))
        if empty == crowded:
            return


@compiled()
def _below(light: FloatImage, value: float) -> int:
    """The largest index whose light is at most ``value``, up to the last but one."""
    low, high = 0, light.size - 1
    while high - low > 1:
        middle = (low + high) // 2
        if light[middle] <= value:
            low = middle
        else:
            high = middle
    return low


@compiled(parallel=True)
def _threshold(frame: FloatImage, light: FloatImage, noise: FloatImage, down: int, along: int, out: ByteImage) -> None:
    rows, columns, _ = frame.shape
    for y in prange(rows):
        for x in range(columns):
            for c in range(3):
                value = min(max(frame[y, x, c], light[c, 0]), light[c, 255])
                i = _below(light[c], value)
                gap = light[c, i + 1] - light[c, i]
                part = (value - light[c, i]) / gap if gap > 0 else np.float32(0)
                # Channels read the tile at different places, or colours would speckle together as grey does.
                limit = noise[(y + down + 21 * c) % TILE, (x + along + 43 * c) % TILE]
                out[y, x, c] = i + 1 if part > limit else i
