"""Windows of projector pixels, one for each camera site, and the tables of one-dimensional shares they are made of.

A site of the camera (one colour of one pixel) sees the projector's image plane at a place phi, blurred by a Gaussian of
covariance S. Its light is shared out over the projector pixels around phi. A window is kept as parameters, 15 bytes
whatever its size; the shares come from tables. There are three sorts of windows: small and upright, small and skewed,
and any others, whose rows a skewed S shifts along x (docs/decisions/0006).

A share is the light of a projector pixel at a point of the projector's image plane. Each table row holds the shares of
the pixels around one position, and sums to 1: so does every product of two rows.

Windows are sorted by projector, colour and tile of the projector's image. Each such cell has a small buffer that stays
in the processor's near caches. Nothing is assumed about where neighbouring sites look: folds and occlusions are only
windows in other cells.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from controller.core.arrays import FloatImage
from controller.core.jit import compiled

PHASE_BITS: Final = 8
PHASES: Final = 1 << PHASE_BITS
"""Positions between two pixels: to 1/512 of a projector pixel."""
SMALLEST_PX: Final = 0.2
STEP: Final = 1.02
KINDS: Final = 150
"""Standard deviations from 0.2 to 3.8 projector pixels, each 2 % above the last: at most 1 % off."""
CUT: Final = 2.5
"""Windows reach at least this many standard deviations."""
LANES: Final = 4
"""Windows are multiples of this wide and high."""
SMALL_PHASES: Final = 2 * PHASES
"""Positions of small windows reach half a pixel beyond the gap between two pixels, because a skew moves them."""
SHEAR_BITS: Final = 6
SHEARS: Final = 1 << SHEAR_BITS
"""Steps of a large window's shift, a projector row, in a pixel."""
SKEWS: Final = 32
"""Steps of a small window's skew in an inverse square pixel."""
SKEW_STEPS: Final = 127
GROUP: Final = 16
"""Small windows are walked so many at a time: as many as one has shares."""
LINE: Final = 64


class Profiles(NamedTuple):
    """``table`` float32, flat: rows of ``size[kind]`` shares; kind k's row for phase f begins at
    ``first[k] + f * size[k]``. ``first`` int64, ``size`` int64: (KINDS,). ``small`` (1,) int64: kinds below it are
    LANES wide, so that row f of kind k begins at LANES (k PHASES + f)."""

    table: FloatImage
    first: npt.NDArray[np.int64]
    size: npt.NDArray[np.int64]
    small: npt.NDArray[np.int64]


def sigma_of(kind: npt.NDArray[np.integer]) -> npt.NDArray[np.float64]:
    """Standard deviation of a kind, projector pixels."""
    return SMALLEST_PX * np.power(STEP, kind.astype(np.float64))


def build_profiles() -> Profiles:
    """The table of all kinds and phases: normalised Gaussians."""
    sigma = sigma_of(np.arange(KINDS))
    # an even window around the gap that the position lies in: what is left out is half the window away at least
    size = (LANES * np.ceil(2 * CUT * sigma / LANES)).astype(np.int64)
    first = np.concatenate([[0], np.cumsum(PHASES * size)[:-1]])
    position = (np.arange(PHASES) + 0.5) / PHASES
    rows = []
    for s, n in zip(sigma, size, strict=True):
        apart = position[:, None] - (np.arange(n) - (n // 2 - 1))[None, :]
        # relative to the nearest pixel, so that not all vanish between two pixels of a narrow one
        exponent = -0.5 * (apart / s) ** 2
        share = np.exp(exponent - exponent.max(axis=1, keepdims=True))
        rows.append((share / share.sum(axis=1, keepdims=True)).ravel())
    return Profiles(
        np.concatenate(rows).astype(np.float32),
        first.astype(np.int64),
        size,
        np.array([np.count_nonzero(size == LANES)]),
    )


class SmallProfiles(NamedTuple):
    """What windows of LANES by LANES are made of.

    ``table`` float32, flat: row f of kind k, LANES shares that sum to 1, begins at LANES (k SMALL_PHASES + f); row f is
    that of position (f + 1/2) / PHASES - 1/2. ``skews`` float32, flat: for each skew from -SKEW_STEPS to SKEW_STEPS
    the LANES by LANES factors by which the product of two rows differs from a Gaussian with that skew.
    """

    table: FloatImage
    skews: FloatImage


@lru_cache(maxsize=1)
def build_small_profiles() -> SmallProfiles:
    """The tables of small windows. Not to be written to."""
    sigma = sigma_of(np.arange(KINDS))
    sigma = sigma[2 * CUT * sigma <= LANES]
    position = (np.arange(SMALL_PHASES) + 0.5) / PHASES - 0.5
    apart = position[:, None] - np.arange(-1, LANES - 1)
    exponent = -0.5 * (apart / sigma[:, None, None]) ** 2
    shares = np.exp(exponent - exponent.max(axis=2, keepdims=True))
    shares /= shares.sum(axis=2, keepdims=True)
    from_middle = np.arange(LANES) - (LANES - 1) / 2
    skew = np.arange(-SKEW_STEPS, SKEW_STEPS + 1) / SKEWS
    factors = np.exp(-skew[:, None] * np.outer(from_middle, from_middle).ravel())
    return SmallProfiles(_aligned(shares.ravel()), _aligned(factors.ravel()))


def _aligned(values: npt.NDArray[np.float64]) -> FloatImage:
    """The values in single precision, from the beginning of a line of the processor's cache on."""
    room = np.empty(values.size + LINE // 4, np.float32)
    skipped = -room.ctypes.data % LINE // 4
    room[skipped : skipped + values.size] = values
    return room[skipped : skipped + values.size]


TILE: Final = 64
NEAR: Final = 4
STRIP: Final = TILE + 2 * NEAR
"""Rows and columns that the small windows of a tile reach; see ``simd.small_windows``."""
MOST_SHEAR: Final = 1.2
"""With the widest profile, windows reach less than half a tile beyond their tile: those of a turn stay apart."""
LEAST_SHEAR: Final = 3
"""Steps up to this are taken as none, because windows without are faster."""
LEAST_INSIDE: Final = 0.05
"""A site with less than this share of its window inside the frame is not lit by it."""
BEYOND: Final = 2
UPRIGHT, SKEWED, OTHER = 0, 1, 2
SORTS: Final = 3


class Windows(NamedTuple):
    """The windows of all projectors, by cell and sort.

    ``site`` (windows,) int32: camera site; ``at`` uint16: first pixel in the cell's buffer, for small windows strip
    times STRIP plus row; ``across``, ``down`` uint16: the table's row for x and y, kind times phases plus position
    between two pixels; ``skew`` int8: how far each row is moved along x, for small windows what couples x and y
    ``gain`` float32: white light at the site over the sum of its shares; 0 in copies that fill a group up
    ``first`` (SORTS cells + 1,) int64: each cell's upright, skewed and other windows, the former two in whole groups
    ``place`` (cells, 4) int64: projector, colour, top, left of the tile
    ``turn`` (tiles,) int64: the tiles, each by its cell of the first colour, in the order in which products take them;
    ``turn_first`` int64: where those of a projector, band and turn begin, in this order; see ``windows.build``
    ``start`` (projectors + 1,) int64: first pixel of each projector; ``size`` (projectors, 2) int64: rows, columns
    ``cell_first`` (projectors + 1,) int64: each projector's cells; ``halo`` (1,) int64: of the buffers
    """

    site: npt.NDArray[np.int32]
    at: npt.NDArray[np.uint16]
    across: npt.NDArray[np.uint16]
    down: npt.NDArray[np.uint16]
    skew: npt.NDArray[np.int8]
    gain: FloatImage
    first: npt.NDArray[np.int64]
    place: npt.NDArray[np.int64]
    turn: npt.NDArray[np.int64]
    turn_first: npt.NDArray[np.int64]
    start: npt.NDArray[np.int64]
    size: npt.NDArray[np.int64]
    cell_first: npt.NDArray[np.int64]
    halo: npt.NDArray[np.int64]


@compiled()
def kind_of(variance: float) -> int:
    """The profile nearest to a variance, projector pixels squared."""
    kind = int(np.floor(0.5 * np.log(max(variance, 1e-6) / SMALLEST_PX**2) / np.log(STEP) + 0.5))
    return min(max(kind, 0), KINDS - 1)
