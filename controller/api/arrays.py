"""Arrays of the caller's types as the numeric packages take them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from controller.core.arrays import FloatImage


def as_image(values: npt.ArrayLike) -> FloatImage:
    """Contiguous float32; without a copy where it is that already."""
    return np.ascontiguousarray(values, np.float32)


def as_images(values: Sequence[npt.ArrayLike]) -> list[FloatImage]:
    return [as_image(one) for one in values]
