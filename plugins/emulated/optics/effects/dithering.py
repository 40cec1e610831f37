"""Grey levels that a panel makes of two levels in turn, one frame each: short exposures see some of the turns alone."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

FloatImage = npt.NDArray[np.float32]
ORDER: Final = np.array([[0, 8, 2, 10], [12, 4, 14, 6], [3, 11, 1, 9], [15, 7, 13, 5]])
"""Bayer's matrix: adjacent pixels take their turns at different times."""


def mean_light(light: FloatImage, *, levels: int, turns: int, start: float, frames: float) -> FloatImage:
    """The mean light (rows, columns, 3) of a dithered panel during an exposure.

    ``light``: wanted, 0 to 1; ``levels``: that the panel makes in one frame; ``turns``: frames in which it comes round;
    ``start``: when the shutter opens, in frames; ``frames``: how long it is open, in frames
    """
    steps = np.float32(levels - 1)
    low = np.floor(light * steps)
    # so many of the turns show the level above
    above = np.rint((light * steps - low) * np.float32(turns))
    rows, columns = light.shape[:2]
    phase = np.tile(ORDER, (rows // 4 + 1, columns // 4 + 1))[:rows, :columns, None] * turns // ORDER.size
    mean = np.zeros_like(light)
    for turn, weight in enumerate(seen_of_turns(turns, start, frames)):
        mean += np.float32(weight) * (((turn + phase) % turns) < above)
    return np.asarray((low + mean) / steps, np.float32)


def seen_of_turns(turns: int, start: float, frames: float) -> npt.NDArray[np.float64]:
    """Share (turns,) of an exposure that lies in each turn; they sum to 1."""
    edges = np.arange(turns + 1)

    def until(moment: float) -> npt.NDArray[np.float64]:
        rounds, rest = divmod(moment, turns)
        return np.asarray(rounds + np.clip(rest - edges[:-1], 0.0, 1.0))

    seen = until(start + frames) - until(start)
    return np.asarray(seen / seen.sum())
