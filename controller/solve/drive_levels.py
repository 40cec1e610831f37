"""How hard the projectors must be driven for a light: brightness and colour in reach at each camera pixel."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from numba import prange

from controller.core.arrays import FloatImage, Mask, array_in_file, strips
from controller.core.channels import smallest
from controller.core.jit import compiled
from controller.transport import LightTransport

ALL: Final = slice(None)


class DriveLevels:
    """Turns light at a camera pixel into the colour that all projectors would show alike to make it.

    At a pixel, B = sum over n of diag(W_n) M_n is the light of the three channels, all projectors together. A light is
    surely within reach where B^-1 light lies in [0, 1]: brightness and the crosstalk of the colours in one. (Where the
    primaries of the projectors differ, a little more can be reached by unequal frames.) White segments make part of
    what the three colours have in common: levels are those of the colours' own light.
    """

    def __init__(self, transport: LightTransport, folder: Path | None = None) -> None:
        """``folder``: for a nameless file of what need not stay in memory; None: it stays there."""
        self.mask: Mask = transport.object_mask
        pixels = sum(rows * columns for rows, columns in transport.sizes)
        ones = np.ones((3, pixels), np.float32)
        shape = (3, 3, *transport.camera_shape)
        self._light = array_in_file(folder, shape)
        self._light[:] = 0
        segment, total = np.zeros(transport.camera_shape, np.float32), np.zeros(transport.camera_shape, np.float32)
        for n, mixing in enumerate(transport.mixing):
            white = transport.forward_planes(ones, projectors=(n, n + 1))
            for channel in range(3):
                for colour in range(3):
                    self._light[channel, colour] += mixing[channel, colour] * white[channel]
            if transport.segments:
                segment += np.float32(transport.segment(n)) * white.sum(axis=0)
                total += white.sum(axis=0)
        # projectors of one kind stand together: where they differ, the mean by their light
        self._segment = np.divide(segment, total, out=segment, where=total > 0) if transport.segments else None

    def of(self, light: FloatImage, rows: slice = ALL) -> FloatImage:
        """(rows, columns, 3) float32 for a light of that shape, without the black image; 0 outside the object.

        Infinite where the projectors' colours are not independent. ``rows``: those of the picture that ``light`` has.
        """
        out = np.zeros(light.shape, np.float32)
        first = rows.indices(len(self.mask))[0]
        _solve(self._light, np.ascontiguousarray(light, np.float32), self.mask, first, out)
        if self._segment is not None:
            for part in strips(len(out)):
                share = self._segment[rows][part][..., None]
                # what is below none has no white in it, and an infinite level stays one
                least = smallest(out[part])[..., None]
                out[part] -= share * np.where(np.isfinite(least), np.maximum(least, 0), 0)
                out[part] /= 1 - share
        return out

    def light(self, levels: FloatImage, rows: slice = ALL) -> FloatImage:
        """The light (rows, columns, 3) float32 of such a colour (rows, columns, 3): the inverse of ``of``."""
        out = np.empty(levels.shape, np.float32)
        if self._segment is not None:
            share = self._segment[rows][..., None]
            common = np.maximum(levels.min(axis=2, keepdims=True), 0)
            levels = np.asarray((1 - share) * levels + share * common, np.float32)
        for channel in range(3):
            parts = (self._light[channel, colour, rows] * levels[..., colour] for colour in range(3))
            out[..., channel] = sum(parts)
        return out


@compiled(parallel=True)
def _solve(B: FloatImage, light: FloatImage, mask: Mask, first: int, out: FloatImage) -> None:
    """Cramer's rule at each pixel of ``mask``; ``light`` and ``out`` begin at its row ``first``."""
    rows, columns = light.shape[:2]
    for y in prange(rows):
        for x in range(columns):
            j = first + y
            if not mask[j, x]:
                continue
            a, b, c = B[0, 0, j, x], B[0, 1, j, x], B[0, 2, j, x]
            d, e, f = B[1, 0, j, x], B[1, 1, j, x], B[1, 2, j, x]
            g, h, i = B[2, 0, j, x], B[2, 1, j, x], B[2, 2, j, x]
            r, s, t = light[y, x, 0], light[y, x, 1], light[y, x, 2]
            det = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
            if det == 0.0:
                out[y, x] = np.inf
                continue
            out[y, x, 0] = (r * (e * i - f * h) - b * (s * i - f * t) + c * (s * h - e * t)) / det
            out[y, x, 1] = (a * (s * i - f * t) - r * (d * i - f * g) + c * (d * t - s * g)) / det
            out[y, x, 2] = (a * (e * t - s * h) - b * (d * t - s * g) + r * (d * h - e * g)) / det
