"""Checks of images that callers give."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Final

import numpy as np
import numpy.typing as npt

from controller.core.arrays import FloatImage
from controller.core.errors import UsageError
from hal.runtime.compute import usable_cpus

_PART: Final = 1 << 22
_MOST_THREADS: Final = 8
CAMERA_SIZE = "Make it as large as this stage's camera image."


def check_shape(what: str, found: tuple[int, ...], wanted: tuple[int, ...], remedy: str = CAMERA_SIZE) -> None:
    """Raise UsageError("image-wrong-size") unless both are the same; ``what``: the image's name in a sentence."""
    if found != wanted:
        sizes = [" x ".join(map(str, shape)) for shape in (found, wanted)]
        raise UsageError("image-wrong-size", what=f"The {what} is {sizes[0]} instead of {sizes[1]}.", remedy=remedy)


def check_image(what: str, image: FloatImage, shape: tuple[int, ...]) -> None:
    """As ``check_shape``; raises UsageError("target-not-finite"), too."""
    check_shape(what, image.shape, shape)
    if not all_finite(image):
        raise not_finite(what)


def all_finite(values: npt.NDArray[np.floating]) -> bool:
    """Whether none is NaN or infinite. A sum of squares says so in a third of the time, where it is finite."""
    flat = values.reshape(-1)
    parts = (flat[begin : begin + _PART] for begin in range(0, flat.size, _PART))
    if flat.size <= _PART:
        return _finite(flat)
    with ThreadPoolExecutor(min(usable_cpus(), _MOST_THREADS)) as pool:
        return all(pool.map(_finite, parts))


def _finite(flat: npt.NDArray[np.floating]) -> bool:
    return bool(np.isfinite(np.vdot(flat, flat))) or bool(np.isfinite(flat).all())


def not_finite(what: str) -> UsageError:
    """The error of an image with NaN or infinite pixels."""
    return UsageError(
        "target-not-finite",
        what=f"The {what} has pixels that are not finite numbers.",
        remedy="Replace NaN and infinite pixels, for example by 0 outside the object.",
    )
