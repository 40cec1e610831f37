"""The weights of the smoothness equations in NumPy, as the paper has them: what the kernel is tested against."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from controller.core.arrays import FloatImage
from controller.optics.solve.bounded.initial_estimate import FAINTEST


@dataclass(frozen=True, slots=True)
class EdgeWeights:
    """Weights alpha between a pixel and its right and lower neighbour.

    ``across`` (rows, columns - 1, 3), ``down`` (rows - 1, columns, 3) float32, in [0, 1]
    """

    across: FloatImage
    down: FloatImage


def smoothness_weights(target: FloatImage, observed: FloatImage) -> EdgeWeights:
    """Weights of the smoothness equations between adjacent pixels of one projector (paper 2.4, eq. 3).

    Parameters
    ----------
    target, observed : (rows, columns, 3) float32, linear light, >= 0
        target intensity at each projector pixel, and what that pixel contributes when fully on

    Returns
    -------
    EdgeWeights; 0 beside a pixel that contributes nothing
    """
    faint = FAINTEST * observed.max(initial=0)
    floor = np.float32(max(faint, np.finfo(np.float32).tiny))
    tau = np.divide(target, np.maximum(observed, floor), dtype=np.float32)
    # A pixel in shadow must not tie its neighbours; below any target's tau it is like no other pixel.
    tau[observed <= faint] = np.nan
    return EdgeWeights(across=_alike(tau[:, 1:], tau[:, :-1]), down=_alike(tau[1:], tau[:-1]))


def _alike(a: FloatImage, b: FloatImage) -> FloatImage:
    larger = np.maximum(a, b)
    alpha = np.ones_like(larger)
    np.divide(np.minimum(a, b), larger, out=alpha, where=larger > 0)
    alpha[np.isnan(larger)] = 0
    return alpha
