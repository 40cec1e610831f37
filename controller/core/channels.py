"""Reductions over the colours of a picture. NumPy's own take ten to twenty times as long along so short an axis."""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from typing import Any

import numpy as np
import numpy.typing as npt

from controller.core.arrays import Mask

Picture = npt.NDArray[Any]
"""(..., channels)."""


def largest(picture: Picture) -> Picture:
    """The largest of each pixel's channels, as ``max(axis=-1)``; NaN where one is NaN."""
    return _over(np.maximum, picture)


def smallest(picture: Picture) -> Picture:
    """The smallest of each pixel's channels, as ``min(axis=-1)``; NaN where one is NaN."""
    return _over(np.minimum, picture)


def mean(picture: Picture) -> Picture:
    """The mean of each pixel's channels, as ``mean(axis=-1)``, of an image of floats."""
    return np.asarray(_over(np.add, picture) / picture.dtype.type(picture.shape[-1]))


def total(picture: Picture) -> Picture:
    """The sum of each pixel's channels, as ``sum(axis=-1)``, of an image of floats."""
    return _over(np.add, picture)


def own_light(shown: Picture, segment: float) -> Picture:
    """The colours' part of ``shown`` light, where a white segment adds to what they have in common.

    ``segment``: its share of white, 0 without one, below 1. Above 1 where a colour is too saturated.
    """
    if not segment:
        return shown
    common = smallest(shown)[..., None]
    return np.asarray((shown - shown.dtype.type(segment) * common) / shown.dtype.type(1 - segment))


def products(one: Picture, other: Picture) -> npt.NDArray[np.float64]:
    """(channels,): sum over all pixels of the products of two pictures' values, as ``sum(one * other)``."""
    pairs = ((one[..., channel], other[..., channel]) for channel in range(one.shape[-1]))
    return np.array([np.multiply(a, b).sum(dtype=np.float64) for a, b in pairs])


def length(vectors: Picture) -> Picture:
    """The Euclidean length of each pixel's channels, as ``np.linalg.norm(axis=-1)`` of real numbers."""
    return np.asarray(np.sqrt(_over(np.add, vectors * vectors)))


def some(mask: npt.NDArray[np.bool_]) -> Mask:
    """Where one of a pixel's channels is true, as ``any(axis=-1)``."""
    return np.asarray(_over(np.logical_or, mask), np.bool_)


def every(mask: npt.NDArray[np.bool_]) -> Mask:
    """Where all of a pixel's channels are true, as ``all(axis=-1)``."""
    return np.asarray(_over(np.logical_and, mask), np.bool_)


def finite(picture: Picture) -> Mask:
    """Where all of a pixel's channels are finite."""
    return every(np.isfinite(picture))


def _over(operation: Callable[[Picture, Picture], Picture], picture: Picture) -> Picture:
    return reduce(operation, (picture[..., channel] for channel in range(picture.shape[-1])))
