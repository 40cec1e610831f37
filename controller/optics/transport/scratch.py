"""Memory that a product needs for a moment, kept for the next one: fresh memory costs as much as filling it does."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from controller.core.arrays import FloatImage

_scratch: list[FloatImage] = []


@contextmanager
def borrow(shape: tuple[int, ...]) -> Iterator[FloatImage]:
    """A float32 array with any content. A simultaneous caller gets another one; one is kept afterwards."""
    # pop and append of a list are atomic
    try:
        array = _scratch.pop()
    except IndexError:
        array = np.empty(0, np.float32)
    if array.shape != shape:
        array = np.empty(shape, np.float32)
    try:
        yield array
    finally:
        if not _scratch:
            _scratch.append(array)
