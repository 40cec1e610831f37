"""Where a projector's colours lie apart, what that does to grey pictures: to the places and the contrasts of sinusoids.

The camera sees a grey sinusoid as the sum of three, one of each colour of the projector, as strong as the paint throws
it back. Its place is a mean of theirs, and they cancel each other in part. Both follow from the white image and are
taken back, so that places are those of green everywhere (docs/decisions/0006).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

import numpy as np

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, strips
from controller.optics.calibrate.correspondence.phase_shift import FRINGE_PX


@dataclass(frozen=True, slots=True, eq=False)
class ColourPlaces:
    """A projector's colours in the pictures of a camera whose channels were added up.

    ``shifts_px`` (3, 2): see ``colour_alignment.ColourShifts``; ``mixing`` (3, 3): see ``Radiometry``
    ``white`` (camera rows, columns, 3), less black, NaN where not known
    ``typical`` (3,): part of the whole white image's light that is the projector's red, green and blue
    """

    shifts_px: Float64
    white: FloatImage
    mixing: FloatImage
    typical: FloatImage

    @classmethod
    def of(cls, shifts_px: Float64, white: FloatImage, mixing: Float64) -> Self:
        """From a white image (rows, columns, 3), less black, NaN where not known, and (3, 3) colour mixing."""
        plain = mixing.astype(np.float32)
        parts = (np.nansum(white[rows], axis=(0, 1), dtype=np.float64) for rows in strips(len(white)))
        light = np.sum(list(parts), axis=0) @ mixing
        typical = light / light.sum() if light.sum() > 0 else np.full(3, 1 / 3)
        return cls(np.asarray(shifts_px, np.float64), white, plain, typical.astype(np.float32))

    def shares(self) -> Iterator[tuple[slice, FloatImage]]:
        """Rows, and (those rows, columns, 3) the parts of white's light that are red, green and blue there.

        Where white is not known or dark, they are ``typical``. They are worked out again where they are needed: kept,
        those of a large camera would fill its memory.
        """
        for rows in strips(len(self.white)):
            light = np.asarray(self.white[rows] @ self.mixing, np.float32)
            whole = channels.total(light)
            known = np.isfinite(whole) & (whole > 0)
            with np.errstate(invalid="ignore", divide="ignore"):
                light /= whole[..., None]
            light[~known] = self.typical
            yield rows, light

    def to_green_px(self) -> FloatImage:
        """(rows, columns, 2): what the place of a fine grey sinusoid lacks to be that of green."""
        found = np.empty((*self.white.shape[:2], 2), np.float32)
        waves = np.exp(2j * np.pi / FRINGE_PX * self.shifts_px).astype(np.complex64)
        for rows, share in self.shares():
            found[rows] = np.angle(share @ waves) * np.float32(FRINGE_PX / (2 * np.pi))
        return found

    def contrast(self, frequency: tuple[float, float]) -> FloatImage:
        """(rows, columns): what is left of a grey sinusoid's contrast at green's phase; cycles a projector pixel."""
        found = np.empty(self.white.shape[:2], np.float32)
        waves = np.cos(2 * np.pi * self.shifts_px @ np.array(frequency)).astype(np.float32)
        for rows, share in self.shares():
            found[rows] = share @ waves
        return found
