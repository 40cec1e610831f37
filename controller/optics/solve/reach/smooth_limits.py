"""A smooth limit over what single pixels need: an elastic sheet that lies on obstacles, on the object alone.

The sheet is the least one above its obstacles of all that are held down by springs and drawn flat by their tension
(the obstacle problem); it is found on cells of about a hundredth of the picture by active sets.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, Self

import cv2
import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from controller.core.arrays import Float64, FloatImage, Mask, strips

CELL: Final = 0.012
"""Side of a cell, relative to the picture's longer side."""
LEAST_SIDE_PX: Final = 4
THIN: Final = 0.005
"""Obstacles narrower than this part of the picture are left out: grazing edges, specks, noise."""
QUANTILE: Final = 0.95
"""Of the needs in a cell, the one that counts as its obstacle."""
REACH: Final = 0.04
"""How far the sheet needs to fall to 1/e beside an obstacle, relative to the picture's longer side."""
ROUNDS: Final = 60
SOFT_CELLS: Final = 0.7
"""Standard deviation of the last smoothing, in cells."""
BESIDE: Final = 4
"""Cells beside the object's that the last smoothing reaches."""


@dataclass(frozen=True, slots=True, eq=False)
class SmoothLimits:
    """The cells of one object, for any number of limits.

    ``box``: rows and columns of the picture around the object, whole cells; ``mask`` (rows, columns) of the object in
    it; ``thin``: the side in pixels of what is left out; ``side`` of a cell in pixels; ``cells`` (rows, columns of
    cells): those with a pixel of the object; ``stiffness`` (cells, cells): springs and tension
    """

    box: tuple[slice, slice]
    mask: Mask
    thin: int
    side: int
    cells: Mask
    stiffness: Any

    @classmethod
    def on(cls, mask: Mask) -> Self:
        """For an object's ``mask`` (rows, columns)."""
        longer = max(mask.shape)
        side = max(LEAST_SIDE_PX, round(CELL * longer))
        box = _around(mask, side)
        mask = mask[box]
        cells = np.asarray(_blocks(mask, side).any(axis=2), np.bool_)
        length = REACH * longer / side
        tension = _differences(cells)
        stiffness = sp.identity(tension.shape[1]) + length**2 * (tension.T @ tension)
        return cls(box, mask, round(THIN * longer) | 1, side, cells, sp.csr_matrix(stiffness))

    def above(self, need: FloatImage) -> FloatImage:
        """(rows, columns) float32: a smooth limit above ``need`` of that shape, where this is more than 0; 0 far off.

        Narrow obstacles and a twentieth of each cell's pixels may stand out of it.
        """
        found, need = np.zeros(need.shape, np.float32), need[self.box]
        if not (self.mask & (need > 0)).any():
            return found
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (self.thin, self.thin))
        wide = cv2.morphologyEx(
            np.where(self.mask, need, 0).astype(np.float32), cv2.MORPH_OPEN, disc,
            borderType=cv2.BORDER_CONSTANT, borderValue=0,
        )  # fmt: skip
        inside = _blocks(self.mask, self.side)[self.cells]
        obstacle = _quantile(_blocks(wide, self.side)[self.cells], inside, QUANTILE)
        lying = np.zeros(self.cells.shape, np.float32)
        lying[self.cells] = lowest_above(self.stiffness, obstacle)
        found[self.box] = self._on_pixels(lying)
        return found

    def _on_pixels(self, values: FloatImage) -> FloatImage:
        """Values of cells, interpolated over those that hold a pixel of the object."""
        columns, rows = (np.arange(n, dtype=np.float32) for n in self.mask.shape[::-1])
        across, down = (((at - (self.side - 1) / 2) / self.side).astype(np.float32) for at in (columns, rows))
        soft = [cv2.GaussianBlur(image, (0, 0), SOFT_CELLS) for image in (values, self.cells.astype(np.float32))]
        found = np.empty(self.mask.shape, np.float32)
        for part in strips(len(found)):
            at = np.meshgrid(across, down[part])
            value, share = (cv2.remap(one, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for one in soft)
            found[part] = np.where(self.mask[part], value / np.maximum(share, np.float32(1e-3)), 0)
        return found


def _around(mask: Mask, side: int) -> tuple[slice, slice]:
    """Rows and columns of whole cells around a mask, with as many more as the last smoothing reaches."""
    spans = []
    for across in (1, 0):
        at = np.flatnonzero(mask.any(axis=across))
        first, last = (0, -1) if at.size == 0 else (int(at[0]) // side - BESIDE, int(at[-1]) // side + BESIDE)
        spans.append(slice(max(first, 0) * side, min((last + 1) * side, mask.shape[1 - across])))
    return spans[0], spans[1]


def lowest_above(stiffness: Any, obstacle: Float64) -> Float64:
    """The sheet h (cells,) of least h' A h / 2 with h >= ``obstacle`` (cells,); A = ``stiffness``, an M-matrix.

    Where it lies on an obstacle it presses on it; elsewhere A h = 0 (Hintermueller, Ito, Kunisch 2003).
    """
    from scipy.sparse.linalg import splu

    lies = obstacle > 0
    height = np.where(lies, obstacle, 0.0)
    for _ in range(ROUNDS):
        height = np.where(lies, obstacle, 0.0)
        free = np.flatnonzero(~lies)
        if free.size and lies.any():
            part = stiffness[free]
            height[free] = splu(sp.csc_matrix(part[:, free])).solve(-(part @ height))
        pressed = stiffness @ height
        after = np.where(lies, pressed > 0, height < obstacle - 1e-9)
        if (after == lies).all():
            break
        lies = after
    return np.asarray(np.maximum(height, obstacle))


def _quantile(values: FloatImage, counted: Mask, share: float) -> Float64:
    """(cells,): the quantile of each row's values that are counted, at least one, as ``np.nanquantile``.

    That calls Python code for every row, which took most of the time of adapting a target.
    """
    ordered = np.sort(np.where(counted, values, np.inf), axis=1)
    last = counted.sum(axis=1) - 1
    at = share * last
    below = np.floor(at).astype(np.int64)
    row = np.arange(len(ordered))
    low, high = (ordered[row, place].astype(np.float64) for place in (below, np.minimum(below + 1, last)))
    return np.asarray(low + (high - low) * (at - below), np.float64)


def _differences(cells: Mask) -> Any:
    """(pairs, cells): one row for each two cells side by side, their difference."""
    number = np.full(cells.shape, -1)
    number[cells] = np.arange(int(cells.sum()))
    pairs = [(a[both], b[both]) for a, b in ((number[1:], number[:-1]), (number[:, 1:], number[:, :-1]))
             for both in ((a >= 0) & (b >= 0),)]  # fmt: skip
    first, second = (np.concatenate(part) for part in zip(*pairs, strict=True))
    row = np.arange(first.size)
    values = np.concatenate([np.ones(first.size), -np.ones(first.size)])
    at = (np.concatenate([row, row]), np.concatenate([first, second]))
    return sp.csr_matrix((values, at), shape=(first.size, int(cells.sum())))


def _blocks(image: npt.NDArray[Any], side: int) -> npt.NDArray[Any]:
    """(rows of cells, columns of cells, pixels): the pixels of each cell; what lies beyond the picture is 0."""
    rows, columns = (-(-n // side) for n in image.shape)
    whole = np.pad(image, ((0, rows * side - image.shape[0]), (0, columns * side - image.shape[1])))
    return whole.reshape(rows, side, columns, side).transpose(0, 2, 1, 3).reshape(rows, columns, -1)
