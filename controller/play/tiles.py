"""What is known of a picture's tiles, so that only those that change are copied, mixed or uploaded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

_COPIED_ROWS = 256
"""At most so many rows are one part: several threads can share a picture of which nothing is known."""


@dataclass(frozen=True, slots=True, eq=False)
class Tiles:
    """The tiles of one picture: their size, and (rows, columns) uint64 numbers; equal numbers, equal pixels.

    0 stands for pixels of which nothing is known.
    """

    width_px: int
    height_px: int
    content: npt.NDArray[np.uint64]


def same_tiles(one: Tiles | None, other: Tiles | None) -> npt.NDArray[np.bool_] | None:
    """(rows, columns): which tiles two pictures have in common; None where that can not be said."""
    if one is None or other is None or (one.width_px, one.height_px) != (other.width_px, other.height_px):
        return None
    same: npt.NDArray[np.bool_] = (one.content == other.content) & (one.content != 0)
    return same


def differing(shape: tuple[int, ...], one: Tiles | None, other: Tiles | None) -> list[tuple[slice, slice]]:
    """Parts (rows, columns) of a picture of this shape that together hold all in which two pictures may differ."""
    same = same_tiles(one, other)
    if same is None or one is None:
        return [
            np.s_[top : min(top + _COPIED_ROWS, shape[0]), 0 : shape[1]] for top in range(0, shape[0], _COPIED_ROWS)
        ]
    found = []
    for row, line in enumerate(same):
        edges = np.flatnonzero(np.diff(line, prepend=True, append=True)).tolist()
        top = row * one.height_px
        for first, last in zip(edges[::2], edges[1::2], strict=True):
            columns = slice(first * one.width_px, min(last * one.width_px, shape[1]))
            found.append((slice(top, min(top + one.height_px, shape[0])), columns))
    return found
