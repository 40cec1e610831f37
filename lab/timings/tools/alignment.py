"""One set of points aligned with another, written separately: the judge shares no code with what it judges."""

from __future__ import annotations

import numpy as np

from controller.core.arrays import Float64


def similarity(a: Float64, b: Float64) -> tuple[float, Float64, Float64]:
    """Scale, rotation and translation that take points ``a`` (n, 3) to ``b`` with least squares (Umeyama 1991)."""
    mean_a, mean_b = a.mean(axis=0), b.mean(axis=0)
    left, values, right = np.linalg.svd((b - mean_b).T @ (a - mean_a) / len(a))
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    turn = left @ sign @ right
    scale = float(np.trace(np.diag(values) @ sign) / np.mean(np.sum((a - mean_a) ** 2, axis=1)))
    return scale, turn, mean_b - scale * turn @ mean_a
