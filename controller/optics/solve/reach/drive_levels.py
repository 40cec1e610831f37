"""How hard the projectors must be driven for a light: brightness and colour in reach at each camera pixel."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final, Self

import numpy as np
import numpy.typing as npt
from numba import prange

from controller.core.arrays import FloatImage, Mask, array_in_file
from controller.core.jit import compiled
from controller.optics.transport import LightTransport

ALL: Final = slice(None)
Colour = tuple[np.float32, np.float32, np.float32]
NO_SEGMENTS: Final = np.zeros((0, 0), np.float32)
Places = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class DriveLevels:
    """Turns light at a camera pixel into the colour that all projectors would show alike to make it.

    At a pixel, B = sum over n of diag(W_n) M_n is the light of the three channels, all projectors together. A light is
    surely within reach where B^-1 light lies in [0, 1]: brightness and the crosstalk of the colours in one. (Where the
    primaries of the projectors differ, a little more can be reached by unequal frames.) White segments make part of
    what the three colours have in common: levels are those of the colours' own light.

    ``mask`` (rows, columns): the object; ``matrices`` (3, 3, rows, columns): B
    ``segment_share`` (rows, columns): what white segments are of all light, 0 x 0 where no projector has one
    ``folder``: for nameless files of what need not stay in memory; None: it stays there
    """

    mask: Mask
    matrices: FloatImage
    segment_share: FloatImage
    folder: Path | None = None

    @classmethod
    def of_transport(cls, transport: LightTransport, folder: Path | None = None) -> Self:
        """Of all pixels of a stage's camera."""
        pixels = sum(rows * columns for rows, columns in transport.sizes)
        ones = np.ones((3, pixels), np.float32)
        shape = (3, 3, *transport.camera_shape)
        matrices = array_in_file(folder, shape)
        matrices[:] = 0
        segment, total = np.zeros(transport.camera_shape, np.float32), np.zeros(transport.camera_shape, np.float32)
        for n in range(len(transport.sizes)):
            mixing = transport.mixing_of(n)
            white = transport.forward_planes(ones, projectors=(n, n + 1))
            for channel in range(3):
                for colour in range(3):
                    matrices[channel, colour] += mixing[channel, colour] * white[channel]
            if transport.segments:
                segment += np.float32(transport.segment(n)) * white.sum(axis=0)
                total += white.sum(axis=0)
        # projectors of one kind stand together: where they differ, the mean by their light
        share = np.divide(segment, total, out=segment, where=total > 0) if transport.segments else NO_SEGMENTS
        return cls(transport.object_mask, matrices, share, folder)

    def at(self, rows: Places, columns: Places) -> Self:
        """Of the camera's pixels in some rows and columns alone."""
        kept = np.ix_(rows, columns)
        share = self.segment_share[kept] if self.segment_share.size else NO_SEGMENTS
        matrices = np.ascontiguousarray(self.matrices[:, :, kept[0], kept[1]])
        return dataclasses.replace(self, mask=self.mask[kept], matrices=matrices, segment_share=share, folder=None)

    @cached_property
    def reach(self) -> FloatImage:
        """The light with every projector at white, (rows, columns, 3)."""
        found = array_in_file(self.folder, (*self.mask.shape, 3))
        np.sum(self.matrices, axis=1, out=np.moveaxis(found, -1, 0))
        return found

    def of(self, light: FloatImage, rows: slice = ALL) -> FloatImage:
        """(rows, columns, 3) float32 for a light of that shape, without the black image; 0 outside the object.

        Infinite where the projectors' colours are not independent. ``rows``: those of the picture that ``light`` has.
        """
        out = np.zeros(light.shape, np.float32)
        first = rows.indices(len(self.mask))[0]
        light = np.ascontiguousarray(light, np.float32)
        _levels(self.matrices, self.segment_share, light, self.mask, first, out)
        return out


@compiled(parallel=True)
def _levels(
    matrices: FloatImage, segment_share: FloatImage, light: FloatImage, mask: Mask, first: int, out: FloatImage
) -> None:
    """``levels_at`` each pixel of ``mask``; ``light`` and ``out`` begin at its row ``first``."""
    rows, columns = light.shape[:2]
    for y in prange(rows):
        for x in range(columns):
            if mask[first + y, x]:
                found = levels_at(matrices, segment_share, first + y, x, light[y, x, 0], light[y, x, 1], light[y, x, 2])
                for c in range(3):
                    out[y, x, c] = found[c]


@compiled()
def levels_at(
    matrices: FloatImage, segment_share: FloatImage, y: int, x: int, r: np.float32, s: np.float32, t: np.float32
) -> Colour:
    """The colour that all projectors would show alike to make the light (r, s, t) at a pixel, by Cramer's rule.

    Infinite where the projectors' colours are not independent. ``matrices``, ``segment_share``: of ``DriveLevels``
    """
    B = matrices[:, :, y, x]
    a, b, c = B[0, 0], B[0, 1], B[0, 2]
    d, e, f = B[1, 0], B[1, 1], B[1, 2]
    g, h, i = B[2, 0], B[2, 1], B[2, 2]
    det = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    if det == 0:
        infinite = np.float32(np.inf)
        return infinite, infinite, infinite
    one = (r * (e * i - f * h) - b * (s * i - f * t) + c * (s * h - e * t)) / det
    two = (a * (s * i - f * t) - r * (d * i - f * g) + c * (d * t - s * g)) / det
    three = (a * (e * t - s * h) - b * (d * t - s * g) + r * (d * h - e * g)) / det
    if segment_share.shape[0]:
        # what is below none has no white in it
        share = segment_share[y, x]
        white = share * max(min(one, two, three), np.float32(0))
        own = np.float32(1) - share
        return (one - white) / own, (two - white) / own, (three - white) / own
    return one, two, three
