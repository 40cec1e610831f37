"""What lenses, sensors and lamps do beyond the ideal; ``core.truth`` says how strongly.

What differs from pixel to pixel and from shot to shot is drawn from the stage's seed. Effects that no usual room has
are in velatura-lab.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt

from plugins.emulated.core.extensions import extension
from plugins.emulated.core.truth import LampTruth

SPREAD: Final = 0.15
"""Standard deviation of the veil, in picture widths."""
COARSE_PX: Final = 96
"""The veil is smooth, so it is worked out in a picture that is so wide."""
FLICKER_S: Final = 0.1
"""Flicker averages out over exposures that are longer."""


@dataclass(frozen=True, slots=True)
class SensorFlaws:
    """``response`` (rows, columns): factor of each pixel; ``dark_e_per_s``: its dark current."""

    response: npt.NDArray[np.float32]
    dark_e_per_s: npt.NDArray[np.float32]


def flickering(lamp: LampTruth, exposure_s: float, rng: np.random.Generator) -> float:
    """Factor on a lamp's mean light during one exposure."""
    if not lamp.flicker:
        return 1.0
    return max(0.0, 1.0 + lamp.flicker / math.sqrt(1.0 + exposure_s / FLICKER_S) * float(rng.standard_normal()))


def veiled(image: npt.NDArray[np.float32], share: float) -> npt.NDArray[np.float32]:
    """A share of the light is stray light of a lens and lies as a veil over the whole picture.

    (1 - share) image + share image * Gaussian, for light (rows, columns, 3); what leaves the picture is lost.
    """
    if share <= 0.0:
        return image
    rows, columns = image.shape[:2]
    coarse = cv2.resize(image, (COARSE_PX, max(1, round(COARSE_PX * rows / columns))), interpolation=cv2.INTER_AREA)
    veil = cv2.GaussianBlur(coarse, (0, 0), SPREAD * COARSE_PX, borderType=cv2.BORDER_CONSTANT)
    whole = cv2.resize(veil, (columns, rows), interpolation=cv2.INTER_LINEAR)
    return np.asarray(cv2.addWeighted(image, 1.0 - share, whole, share, 0.0), dtype=np.float32)


def rare(what: str) -> Any:
    """``lab.emulated.effects``, which ``what`` needs. Raises DeviceError("bench-part-missing")."""
    return extension("effects", asked_by=what)
