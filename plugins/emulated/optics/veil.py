"""Veiling glare: a share of the light in a lens goes astray and lies as a veil over the whole picture."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

SPREAD: Final = 0.15
"""Standard deviation of the veil, in picture widths."""
COARSE_PX: Final = 96
"""The veil is smooth, so it is worked out in a picture that is so wide."""


def veiled(image: npt.NDArray[np.float32], share: float) -> npt.NDArray[np.float32]:
    """(1 - share) image + share image * Gaussian, for light (rows, columns, 3); what leaves the picture is lost."""
    if share <= 0.0:
        return image
    rows, columns = image.shape[:2]
    coarse = cv2.resize(image, (COARSE_PX, max(1, round(COARSE_PX * rows / columns))), interpolation=cv2.INTER_AREA)
    veil = cv2.GaussianBlur(coarse, (0, 0), SPREAD * COARSE_PX, borderType=cv2.BORDER_CONSTANT)
    whole = cv2.resize(veil, (columns, rows), interpolation=cv2.INTER_LINEAR)
    return np.asarray(np.float32(1.0 - share) * image + np.float32(share) * whole, dtype=np.float32)
