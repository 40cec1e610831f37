"""Bends targets so that the object's own pattern doesn't show in their dark and saturated parts.

Cutting a target off at each pixel shows the object's paint: where light of other surfaces falls on a pale patch it
stays pale, and a saturated patch keeps its colour. What is not seen is a limit that varies slowly. So what single
pixels can't make becomes smooth limits (``SmoothLimits``), and the target is bent towards them: what keeps well away
from a limit stays as it is, differences beyond it shrink.

1. Dark: no darker than a smooth floor, in grey, so that shadows don't take on the colour of the light in them. Paint on
   which no grey outshines that colour keeps it, and does not lift what is around.
2. Chroma: no more saturated than can be shown around; the hue and the lightness stay.

What is brighter than the projectors can make is cut off: to hide it, parts in reach would have to be dimmed. Arrays in,
arrays out (docs/decisions/0011).

A smooth limit is an elastic sheet that lies on obstacles, on the object alone: the least one above its obstacles of all
that are held down by springs and drawn flat by their tension (the obstacle problem). It is found on cells of about a
hundredth of the picture by active sets.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, Self

import cv2
import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from numba import prange

from controller.core.arrays import Float64, FloatImage, Mask
from controller.core.errors import UsageError
from controller.core.jit import compiled
from controller.optics.solve.bounded.solver import check_target
from controller.optics.solve.reach.drive_levels import Colour, DriveLevels, levels_at

CELL: Final = 0.012
"""Side of a cell, relative to the picture's longer side."""
LEAST_SIDE_PX: Final = 4
"""A cell's side is at least so many camera pixels."""
THIN: Final = 0.005
"""Obstacles narrower than this part of the picture are ignored: grazing edges, specks, noise."""
QUANTILE: Final = 0.95
"""A cell's obstacle is this quantile of the needs of its pixels."""
REACH: Final = 0.04
"""Beside an obstacle, the sheet falls to 1/e over this distance, relative to the picture's longer side."""
ROUNDS: Final = 60
"""Active sets are tried so often at most."""
SOFT_CELLS: Final = 0.7
"""Standard deviation of the last smoothing, in cells."""
BESIDE: Final = 4
"""So many cells beside those of the object are reached by the last smoothing."""


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
        soft = (cv2.GaussianBlur(image, (0, 0), SOFT_CELLS) for image in (values, self.cells.astype(np.float32)))
        rows, columns = self.mask.shape
        value, share = (
            cv2.resize(one, None, fx=self.side, fy=self.side, interpolation=cv2.INTER_LINEAR)[:rows, :columns]
            for one in soft
        )
        return np.where(self.mask, value / np.maximum(share, np.float32(1e-3)), np.float32(0))


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
            # Symmetric and positive: in half of the time, without pivots.
            solver = splu(
                sp.csc_matrix(part[:, free]), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )  # fmt: skip
            height[free] = solver.solve(-(part @ height))
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
    below = np.stack([number[1:].ravel(), number[:-1].ravel()])
    beside = np.stack([number[:, 1:].ravel(), number[:, :-1].ravel()])
    pairs = np.concatenate([below, beside], axis=1)
    first, second = pairs[:, (pairs >= 0).all(axis=0)]
    row = np.arange(first.size)
    values = np.concatenate([np.ones(first.size), -np.ones(first.size)])
    at = (np.concatenate([row, row]), np.concatenate([first, second]))
    return sp.csr_matrix((values, at), shape=(first.size, int(cells.sum())))


def _blocks(image: npt.NDArray[Any], side: int) -> npt.NDArray[Any]:
    """(rows of cells, columns of cells, pixels): the pixels of each cell; what lies beyond the picture is 0."""
    rows, columns = (-(-n // side) for n in image.shape)
    whole = np.pad(image, ((0, rows * side - image.shape[0]), (0, columns * side - image.shape[1])))
    return whole.reshape(rows, side, columns, side).transpose(0, 2, 1, 3).reshape(rows, columns, -1)


CLEAR: Final = 1.0
"""Chroma counts in full where a target is brighter than its floor by this part of it; in the dark it hardly shows."""
FORGIVEN: Final = 1e-3
"""Drive beyond [0, 1] that is no lack of light."""
LEAST: Final = np.float32(1e-12)


def adapted_target(drive: DriveLevels, wanted: FloatImage, floor: FloatImage, *, strength: float = 1.0) -> FloatImage:
    """``wanted`` (rows, columns, 3) radiance, bent into what the stage can make without showing its own pattern.

    Parameters
    ----------
    wanted, floor : (rows, columns, 3) radiance. ``floor`` is what is there without any projector's direct light: the
        black image, and what other surfaces throw back
    strength : from 0 (leave it, to be cut off) to 1

    Returns the target, float32; what lies beside the object stays as it is. Where nothing is lacking, it is ``wanted``.
    Raises UsageError "image-wrong-size", "target-not-finite" or "adapt-strength".
    """
    if not 0 <= strength <= 1:
        raise UsageError(
            "adapt-strength",
            what=f"A target can't be adapted with strength {strength}.",
            remedy="Give a strength from 0 (too bright or too dark parts are cut off) to 1.",
        )
    check_target(drive.mask.shape, wanted)
    check_target(drive.mask.shape, floor)
    if strength == 0 or not drive.mask.any():
        return np.asarray(wanted, np.float32)
    target = _Bent(np.asarray(wanted, np.float32), np.asarray(floor, np.float32), drive, SmoothLimits.on(drive.mask))
    target.lift()
    target.pale()
    return target.bent(strength)


class _Bent:
    """A target on its way, ``wanted`` and its ``floor`` (rows, columns, 3).

    ``lowest``, ``level`` (rows, columns): the darkest grey of each pixel, and what the smooth floor makes of it;
    ``chroma`` (rows, columns): what is left of the saturation, from 0 to 1
    """

    def __init__(self, wanted: FloatImage, floor: FloatImage, drive: DriveLevels, limits: SmoothLimits) -> None:
        self._wanted, self._floor = np.ascontiguousarray(wanted), np.ascontiguousarray(floor)
        self._stage = drive.matrices, drive.segment_share, drive.mask
        self._limits = limits
        self._lowest = self._level = np.zeros(drive.mask.shape, np.float32)
        self._chroma: FloatImage = np.ones(drive.mask.shape, np.float32)

    def lift(self) -> None:
        """Raise the darkest parts by grey light, where the stage can make a grey that bright at all."""
        need = np.zeros_like(self._lowest)
        _lift_needs(*self._stage, self._wanted, self._floor, self._lowest, need)
        self._level = self._limits.above(need)
        np.maximum(self._lowest, self._level, out=self._lowest)

    def pale(self) -> None:
        """Take chroma away where a channel would have to be darker than dark.

        A channel's share of grey light says how saturated a colour is; the limit is on the smallest of these shares.
        """
        needs = np.zeros((3, *self._chroma.shape), np.float32)
        _chroma_needs(*self._stage, self._wanted, self._floor, self._level, self._lowest, needs)
        if needs.any():
            for channel in range(3):
                needs[channel] = self._limits.above(needs[channel])
            _chroma_left(self._stage[-1], self._wanted, self._level, needs, self._chroma)

    def bent(self, strength: float) -> FloatImage:
        """Both steps together, as strong as ``strength``."""
        changed = self._wanted.copy()
        _bend(self._stage[-1], self._wanted, self._level, self._chroma, np.float32(strength), changed)
        return changed


@compiled(parallel=True)
def _lift_needs(
    matrices: FloatImage, segment_share: FloatImage, mask: Mask, wanted: FloatImage, floor: FloatImage,
    lowest: FloatImage, need: FloatImage,
) -> None:  # fmt: skip
    """The darkest grey at each pixel, and where a target is darker and that grey can be made."""
    rows, columns = mask.shape
    one = np.float32(1)
    for y in prange(rows):
        for x in range(columns):
            if not mask[y, x]:
                continue
            of_floor = levels_at(matrices, segment_share, y, x, floor[y, x, 0], floor[y, x, 1], floor[y, x, 2])
            of_grey = levels_at(matrices, segment_share, y, x, one, one, one)
            darkest, brightest = np.float32(0), np.float32(np.inf)
            for c in range(3):
                darkest = max(darkest, _quotient(of_floor[c], of_grey[c], np.float32(0)))
                brightest = min(brightest, _quotient(of_floor[c] + one, of_grey[c], np.float32(np.inf)))
            lowest[y, x] = darkest
            if darkest <= brightest and _grey(wanted, y, x) < darkest:
                need[y, x] = darkest


@compiled(parallel=True)
def _chroma_needs(
    matrices: FloatImage, segment_share: FloatImage, mask: Mask, wanted: FloatImage, floor: FloatImage,
    level: FloatImage, lowest: FloatImage, needs: FloatImage,
) -> None:  # fmt: skip
    """The least share of grey light (3, rows, columns) that a channel can show, where it can't show its own."""
    rows, columns = mask.shape
    one = np.float32(1)
    for y in prange(rows):
        for x in range(columns):
            if not mask[y, x]:
                continue
            r, s, t, grey = _lifted(wanted, level, y, x)
            dark = floor[y, x, 0], floor[y, x, 1], floor[y, x, 2]
            of_grey = levels_at(matrices, segment_share, y, x, grey - dark[0], grey - dark[1], grey - dark[2])
            of_colour = levels_at(matrices, segment_share, y, x, r - dark[0], s - dark[1], t - dark[2])
            over = (grey / max(lowest[y, x], LEAST) - one) / np.float32(CLEAR)
            clear = min(max(over, np.float32(0)), one)
            lifted = r, s, t
            for c in range(3):
                own = lifted[c] / grey
                if of_colour[c] < -FORGIVEN and own < one:
                    most = max(of_grey[c], np.float32(0))
                    # both are infinite where a colour of light is none
                    kept = _quotient(most, most - of_colour[c], one)
                    needs[c, y, x] = own + clear * (one - kept) * (one - own)


@compiled(parallel=True)
def _chroma_left(mask: Mask, wanted: FloatImage, level: FloatImage, limits: FloatImage, chroma: FloatImage) -> None:
    """What is left of each pixel's saturation by the ``limits`` (3, rows, columns) of its channels' shares of grey."""
    rows, columns = mask.shape
    one = np.float32(1)
    for y in prange(rows):
        for x in range(columns):
            if not mask[y, x]:
                continue
            r, s, t, grey = _lifted(wanted, level, y, x)
            lifted = r, s, t
            left = one
            for c in range(3):
                own = lifted[c] / grey
                if own < one:
                    raised = min(_soft_maximum(own, limits[c, y, x]), one)
                    left = min(left, _quotient(one - raised, one - own, one))
            chroma[y, x] = max(left, np.float32(0))


@compiled(parallel=True)
def _bend(
    mask: Mask, wanted: FloatImage, level: FloatImage, chroma: FloatImage, strength: np.float32, out: FloatImage
) -> None:
    """The target (rows, columns, 3) on the object, lifted and paler."""
    rows, columns = mask.shape
    for y in prange(rows):
        for x in range(columns):
            if mask[y, x]:
                bent = _paler(wanted, level, chroma, y, x)
                for c in range(3):
                    out[y, x, c] += strength * (bent[c] - out[y, x, c])


@compiled()
def _grey(wanted: FloatImage, y: int, x: int) -> np.float32:
    """Lightness from the camera's channels, of which green is that of the eye."""
    none = np.float32(0)
    return _grey_of(max(wanted[y, x, 0], none), max(wanted[y, x, 1], none), max(wanted[y, x, 2], none))


@compiled()
def _grey_of(r: np.float32, s: np.float32, t: np.float32) -> np.float32:
    return np.float32(0.25) * r + np.float32(0.5) * s + np.float32(0.25) * t


@compiled()
def _lifted(
    wanted: FloatImage, level: FloatImage, y: int, x: int
) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """A pixel of the target after ``lift``, and its grey."""
    none = np.float32(0)
    r, s, t = max(wanted[y, x, 0], none), max(wanted[y, x, 1], none), max(wanted[y, x, 2], none)
    grey = _grey_of(r, s, t)
    more = _soft_maximum(grey, level[y, x]) - grey
    r, s, t = r + more, s + more, t + more
    return r, s, t, max(_grey_of(r, s, t), LEAST)


@compiled()
def _paler(wanted: FloatImage, level: FloatImage, chroma: FloatImage, y: int, x: int) -> Colour:
    """A pixel of the target after ``pale``. Full chroma leaves every bit as it is."""
    r, s, t, grey = _lifted(wanted, level, y, x)
    lost = np.float32(1) - chroma[y, x]
    return r + lost * (grey - r), s + lost * (grey - s), t + lost * (grey - t)


@compiled()
def _soft_maximum(value: np.float32, level: np.float32) -> np.float32:
    """At least the larger of both; ``value`` itself where ``level`` is 0."""
    found = max(value, np.float32(0))
    # elsewhere a root of a power is not the number itself, by a bit or two that differ from processor to processor
    if level > 0:
        one, other = found * found, level * level
        found = np.sqrt(np.sqrt(one * one + other * other))
    return found


@compiled()
def _quotient(above: np.float32, below: np.float32, otherwise: np.float32) -> np.float32:
    """``above`` / ``below`` where that is positive, else ``otherwise``."""
    return above / below if below > 1e-9 and np.isfinite(above) and np.isfinite(below) else otherwise
