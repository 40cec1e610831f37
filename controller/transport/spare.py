"""Memory that a product needs for a moment, kept for the next one: fresh memory costs as much as filling it does."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from controller.arrays import FloatImage

_spare: list[FloatImage] = []


@contextmanager
def lent(shape: tuple[int, ...]) -> Iterator[FloatImage]:
    """A float32 array with any content. Whoever calls at the same time gets another one; one is kept afterwards."""
    # pop and append of a list are one step each, whoever else does the same
    try:
        sheet = _spare.pop()
    except IndexError:
        sheet = np.empty(0, np.float32)
    if sheet.shape != shape:
        sheet = np.empty(shape, np.float32)
    try:
        yield sheet
    finally:
        if not _spare:
            _spare.append(sheet)
