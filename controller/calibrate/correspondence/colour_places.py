"""Where a projector's colours lie apart, what that does to grey pictures: to the places and the contrasts of sinusoids.

The camera sees a grey sinusoid as the sum of three, one of each colour of the projector, as strong as the paint throws
it back. Its place is a mean of theirs, and they cancel each other in part. Both follow from the white image and are
taken back, so that places are those of green everywhere (docs/decisions/0082).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from controller.calibrate.correspondence.phase_shift import FRINGE_PX
from controller.core.arrays import Float64, FloatImage


@dataclass(frozen=True, slots=True, eq=False)
class ColourPlaces:
    """A projector's colours in the pictures of a camera whose channels were added up.

    ``shifts_px`` (3, 2): see ``colour_alignment.ColourShifts``
    ``share`` (camera rows, columns, 3) float32: part of white's light that is the projector's red, green and blue
    """

    shifts_px: Float64
    share: FloatImage

    @classmethod
    def of(cls, shifts_px: Float64, white: FloatImage, mixing: Float64) -> Self:
        """From a white image (rows, columns, 3), less black, NaN where not known, and (3, 3) colour mixing.

        Where white is not known or dark, the shares are those of the picture as a whole.
        """
        light = white.astype(np.float32) @ mixing.astype(np.float32)
        whole = light.sum(axis=2, keepdims=True)
        known = np.isfinite(whole[..., 0]) & (whole[..., 0] > 0)
        with np.errstate(invalid="ignore", divide="ignore"):
            share = light / whole
        share[~known] = light[known].mean(axis=0) / whole[known].mean() if known.any() else np.float32(1 / 3)
        return cls(np.asarray(shifts_px, np.float64), np.asarray(share, np.float32))

    def to_green_px(self) -> FloatImage:
        """(rows, columns, 2): what the place of a fine grey sinusoid lacks to be that of green."""
        found = np.empty((*self.share.shape[:2], 2), np.float32)
        for axis in range(2):
            waves = np.exp(2j * np.pi / FRINGE_PX * self.shifts_px[:, axis]).astype(np.complex64)
            found[..., axis] = np.angle(self.share @ waves) * np.float32(FRINGE_PX / (2 * np.pi))
        return found

    def contrast(self, frequency: tuple[float, float]) -> FloatImage:
        """(rows, columns): what is left of a grey sinusoid's contrast at green's phase; cycles a projector pixel."""
        waves = np.cos(2 * np.pi * self.shifts_px @ np.array(frequency)).astype(np.float32)
        return np.asarray(self.share @ waves, np.float32)
