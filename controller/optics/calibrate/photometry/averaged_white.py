"""The white image with less noise: what the steps of each sinusoid add up to is a white image, too.

All that a projector shows is white times something that is known well, so the noise of its white image is in every
frame that is solved. Three steps hold half as much light again as one photograph of white. They are photographed
anyway.
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from controller.core import channels
from controller.core.arrays import FloatImage
from controller.optics.calibrate.correspondence.captures import lit_pixels

AROUND: Final = (15, 15)
"""Camera pixels over which the noise of both is measured."""
FEWEST: Final = 2
"""Sums: fewer do not tell their noise."""
FEWEST_PIXELS: Final = 1_000
"""Lit ones: fewer do not tell how bright the sums are."""
SOME_PIXELS: Final = 200_000


class WhiteSums:
    """White images (rows, columns, 3) from the steps of sinusoids, NaN where not known; their mean and their noise."""

    def __init__(self) -> None:
        self._count = 0
        self._total: FloatImage | None = None
        self._squares: FloatImage | None = None

    def add(self, image: FloatImage) -> None:
        """One more, of the same lamp strength as the others."""
        self._count += 1
        if self._total is None or self._squares is None:
            self._total, self._squares = image.copy(), image * image
            return
        self._total += image
        self._squares += image * image

    def averaged(self, white: FloatImage) -> FloatImage:
        """``white`` (rows, columns, 3) less black, NaN where not known, with less noise, as bright as it was.

        Both are weighted by the noise that is measured around each pixel. ``white`` itself where the sums do not help.
        """
        if self._total is None or self._squares is None or self._count < FEWEST:
            return white
        mean = self._total / np.float32(self._count)
        variance = np.maximum(self._squares - self._total * mean, 0) / np.float32(self._count * (self._count - 1))
        lit = np.flatnonzero((lit_pixels(white) & channels.finite(mean)).ravel())
        if lit.size < FEWEST_PIXELS:
            return white
        some = lit[:: max(1, lit.size // SOME_PIXELS)]
        # the response by which steps are shown is not known well yet: their mean light differs by channel
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = white.reshape(-1, 3)[some] / mean.reshape(-1, 3)[some]
        mean *= np.median(ratio, axis=0).astype(np.float32)
        apart = white - mean
        own, other = (
            cv2.boxFilter(channels.total(np.nan_to_num(one)), -1, AROUND) for one in (variance, apart * apart)
        )
        share = np.divide(own, other, out=np.ones_like(own), where=other > own)[..., None]
        averaged = mean + share * apart
        return np.where(np.isfinite(averaged), np.maximum(averaged, 0), white).astype(np.float32)


__all__ = ["WhiteSums"]
