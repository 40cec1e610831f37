# %% [markdown]
# A method for `velatura compare`: every projector shows one even colour, the best for the mean of the target.
#
#     velatura compare --method docs/examples/compared_method.py:even_colour --method ours --scene dark

# %%
from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from lab.compare.api import ComparisonStage, ComparisonTarget

Frames = list[npt.NDArray[np.uint8]]


# %% Light of several device values, then, for each target, the value whose mean light is nearest.
def even_colour(stage: ComparisonStage) -> Callable[[ComparisonTarget], Frames]:
    """One even colour on all projectors, by photographs of five greys."""

    def even(colour: npt.ArrayLike) -> Frames:
        return [np.full((height, width, 3), colour, np.uint8) for width, height in stage.projectors_px]

    values = np.linspace(0, 255, 5)
    mask = stage.object_mask
    light = np.stack([stage.photograph(even(value))[mask].mean(axis=0) for value in values])

    def frames(target: ComparisonTarget) -> Frames:
        wanted = target.radiance[mask].mean(axis=0)
        return even([np.interp(wanted[channel], light[:, channel], values) for channel in range(3)])

    return frames
