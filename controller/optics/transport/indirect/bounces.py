"""Light that goes from surface to surface more than once, by blocks."""

from __future__ import annotations

from typing import Final

import numpy as np

from controller.core.arrays import FloatImage

Both = tuple[FloatImage, FloatImage]
"""Of the object, and of surfaces that are none of it."""
DOUBLED: Final = 3
"""2^3 bounces are counted. Surfaces throw back less than half of what falls on them on the mean, so 1 % is left."""


def with_bounces(direct: Both, factors: Both, back: Both) -> Both:
    """All light that leaves blocks (blocks, pictures, 3), where ``direct`` light is that of projectors.

    ``factors`` (blocks, blocks): light that falls from blocks of object and room; ``back`` (blocks, 1, 3): what they
    make of light that falls on them
    """
    own, room = direct
    shape = own.shape
    for _ in range(2**DOUBLED):
        falling = sum(one @ light.reshape(len(light), -1) for one, light in zip(factors, (own, room), strict=True))
        falling = np.asarray(falling, np.float32).reshape(shape)
        own, room = direct[0] + back[0] * falling, direct[1] + back[1] * falling
    return own, room


def by_all_ways(factors: Both, back: Both) -> Both:
    """(blocks, blocks) each: light that falls by way of any number of surfaces, for light of projectors alone.

    One matrix for all colours: what is thrown back is the mean of them, and white is made right by colour afterwards.
    ``factors``, ``back``: see ``with_bounces``. A series, and so never negative.
    """
    step = factors[0] * back[0].mean(axis=1) + factors[1] * back[1].mean(axis=1)
    found = np.concatenate(factors, axis=1)
    for number in range(DOUBLED):
        found += step @ found
        step = step @ step if number + 1 < DOUBLED else step
    return found[:, : len(step)], found[:, len(step) :]


__all__ = ["Both", "by_all_ways", "with_bounces"]
