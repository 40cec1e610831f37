"""A Bayer camera's own part of the light transport: one colour a site, the other two interpolated, and the transpose.

The interpolation is that of ``capture.raw``: a site's own colour as measured, the others as the mean of those sites of
the 3x3 around that have them. So pictures are linear in the sites, and what a site sees has no camera colours to mix.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt
from numba import prange

from controller.core.arrays import FloatImage
from controller.core.jit import compiled
from controller.optics.transport.windows.profiles import LINE

BORDER: Final = 2
"""Rows and columns whose neighbours, or neighbours' neighbours, may be outside."""
GREEN: Final = 1
STRIP: Final = 16
"""Rows of a picture that fit a core's second cache, three planes of them."""

Colours = npt.NDArray[np.int64]
"""(2, 2): 0 red, 1 green, 2 blue at even and odd rows and columns."""


@compiled()
def _count(colours: Colours, y: int, x: int, colour: int, rows: int, columns: int) -> int:
    n = 0
    for r in range(max(y - 1, 0), min(y + 2, rows)):
        for c in range(max(x - 1, 0), min(x + 2, columns)):
            n += colours[r & 1, c & 1] == colour
    return n


@compiled()
def _picture_one(sites: FloatImage, colours: Colours, y: int, x: int) -> tuple[float, float, float]:
    rows, columns = sites.shape
    red = green = blue = np.float32(0)
    reds = greens = blues = 0
    for r in range(max(y - 1, 0), min(y + 2, rows)):
        for c in range(max(x - 1, 0), min(x + 2, columns)):
            colour, value = colours[r & 1, c & 1], sites[r, c]
            # no arrays: making them would take longer than all else here
            if colour == 0:
                red, reds = red + value, reds + 1
            elif colour == GREEN:
                green, greens = green + value, greens + 1
            else:
                blue, blues = blue + value, blues + 1
    own, here = colours[y & 1, x & 1], sites[y, x]
    found = (
        here if own == 0 else red / np.float32(max(reds, 1)),
        here if own == GREEN else green / np.float32(max(greens, 1)),
        here if own not in (0, GREEN) else blue / np.float32(max(blues, 1)),
    )
    return float(found[0]), float(found[1]), float(found[2])


@compiled()
def _neighbours(colours: Colours, y: int, x: int, colour: int, rows: int, columns: int) -> int:
    """Of how many sites the mean is that a pixel has in a colour not its own."""
    if not (0 < y < rows - 1 and 0 < x < columns - 1):
        return _count(colours, y, x, colour, rows, columns)
    return 2 if colours[y & 1, x & 1] == GREEN else 4


@compiled()
def _collect_one(planes: FloatImage, above: int, rows: int, colours: Colours, y: int, x: int) -> float:
    """The transpose at one site of a picture of ``rows`` rows; ``planes`` begin with row ``above`` of it."""
    columns = planes.shape[2]
    own = colours[y & 1, x & 1]
    total = float(planes[own, y - above, x])
    for r in range(max(y - 1, 0), min(y + 2, rows)):
        for c in range(max(x - 1, 0), min(x + 2, columns)):
            if colours[r & 1, c & 1] != own:
                total += planes[own, r - above, c] / np.float32(_neighbours(colours, r, c, own, rows, columns))
    return total


@compiled(fastmath=True)
def _interpolate_row(
    above: FloatImage, here: FloatImage, below: FloatImage, at: int, own: FloatImage, green: FloatImage, far: FloatImage
) -> None:
    """One inner row, whose colours are green and one other, the latter at columns of parity ``at``."""
    half, quarter = np.float32(0.5), np.float32(0.25)
    # shifted views, because an index that might be negative can't be vectorised
    n = here.size - 2 * BORDER
    left, h, right = here[1:], here[BORDER:], here[BORDER + 1 :]
    la, a, ra, lb, b, rb = (
        above[1:],
        above[BORDER:],
        above[BORDER + 1 :],
        below[1:],
        below[BORDER:],
        below[BORDER + 1 :],
    )
    own, green, far = own[BORDER:], green[BORDER:], far[BORDER:]
    # one loop each: with three rows to write, more may overlap than the compiler is willing to check
    for i in range(n):
        own[i] = h[i] if (i & 1) == at else half * (left[i] + right[i])
    for i in range(n):
        green[i] = quarter * (left[i] + right[i] + a[i] + b[i]) if (i & 1) == at else h[i]
    for i in range(n):
        far[i] = quarter * (la[i] + ra[i] + lb[i] + rb[i]) if (i & 1) == at else half * (a[i] + b[i])


@compiled(fastmath=True)
def _collect_row(own: FloatImage, green: FloatImage, y: int, at: int, out: FloatImage) -> None:
    """The transpose: ``own`` and ``green`` (rows, columns) are the two planes of the row's colours."""
    half, quarter = np.float32(0.5), np.float32(0.25)
    n = out.size - 2 * BORDER
    above, here, below = own[y - 1], own[y], own[y + 1]
    left, h, right = here[1:], here[BORDER:], here[BORDER + 1 :]
    la, a, ra, lb, b, rb = (
        above[1:],
        above[BORDER:],
        above[BORDER + 1 :],
        below[1:],
        below[BORDER:],
        below[BORDER + 1 :],
    )
    green_here = green[y]
    gl, gh, gr = green_here[1:], green_here[BORDER:], green_here[BORDER + 1 :]
    ga, gb, to = green[y - 1][BORDER:], green[y + 1][BORDER:], out[BORDER:]
    for i in range(n):
        edges, corners = left[i] + right[i] + a[i] + b[i], la[i] + ra[i] + lb[i] + rb[i]
        others = h[i] + half * edges + quarter * corners
        greens = gh[i] + quarter * (gl[i] + gr[i] + ga[i] + gb[i])
        to[i] = others if (i & 1) == at else greens


@compiled()
def _picture_row(
    sites: FloatImage, colours: Colours, y: int, left: int, red: FloatImage, green: FloatImage, blue: FloatImage
) -> None:
    """Row ``y`` of the picture, as many columns of it from ``left``, which is even, as ``red`` has."""
    rows, columns, right = sites.shape[0], red.size, left + red.size
    inner = BORDER <= y < rows - BORDER
    if inner:
        at = 1 if colours[y & 1, 0] == GREEN else 0
        above, here, below = sites[y - 1, left:right], sites[y, left:right], sites[y + 1, left:right]
        if colours[y & 1, at] == 0:
            _interpolate_row(above, here, below, at, red, green, blue)
        else:
            _interpolate_row(above, here, below, at, blue, green, red)
    for x in range(min(BORDER, columns) if inner else columns):
        red[x], green[x], blue[x] = _picture_one(sites, colours, y, left + x)
    for x in range(max(columns - BORDER, BORDER) if inner else columns, columns):
        red[x], green[x], blue[x] = _picture_one(sites, colours, y, left + x)


@compiled()
def _sites_row(planes: FloatImage, above: int, rows: int, colours: Colours, y: int, out: FloatImage) -> None:
    """Row ``y`` of the transpose; ``planes`` begin with row ``above`` of the picture."""
    columns = out.size
    inner = BORDER <= y < rows - BORDER
    if inner:
        at = 1 if colours[y & 1, 0] == GREEN else 0
        _collect_row(planes[colours[y & 1, at]], planes[GREEN], y - above, at, out)
    for x in range(min(BORDER, columns) if inner else columns):
        out[x] = _collect_one(planes, above, rows, colours, y, x)
    for x in range(max(columns - BORDER, BORDER) if inner else columns, columns):
        out[x] = _collect_one(planes, above, rows, colours, y, x)


@compiled(parallel=True)
def interpolate(sites: FloatImage, colours: Colours, out: FloatImage) -> None:
    """Write the picture (3, rows, columns) that a camera makes of its ``sites`` (rows, columns)."""
    for y in prange(sites.shape[0]):
        _picture_row(sites, colours, y, 0, out[0, y], out[1, y], out[2, y])


@compiled(parallel=True)
def collect(planes: FloatImage, colours: Colours, out: FloatImage) -> None:
    """The transpose of ``interpolate``: (3, rows, columns) to sites (rows, columns)."""
    rows = planes.shape[1]
    for y in prange(rows):
        _sites_row(planes, 0, rows, colours, y, out[y])


@compiled(parallel=True, fastmath=True)
def normal_residual(
    sites: FloatImage, colours: Colours, weights: FloatImage, right_hand_side: FloatImage, out: FloatImage
) -> None:
    """Write D' w D sites - right_hand_side, with D the interpolation; all (rows, columns).

    In strips of rows whose pictures stay in a near cache, so that a picture of three planes is never written; between
    the columns that have weights.
    """
    rows, columns = sites.shape
    for i in prange((rows + STRIP - 1) // STRIP):
        first, last = STRIP * i, min(STRIP * (i + 1), rows)
        above = max(first - 1, 0)
        end = min(last + 1, rows)
        left, right = columns, 0
        for y in range(above, end):
            x = 0
            while x < left and _total(weights[y, x : x + LINE]) == 0:
                x += LINE
            left, x = min(left, x), columns
            while x > right and _total(weights[y, max(x - LINE, 0) : x]) == 0:
                x -= LINE
            right = max(right, x)
        # even, and beyond what a weight reaches
        left, right = max(left - left % 2 - 2 * BORDER, 0), min(right + 2 * BORDER, columns)
        if left >= right:
            left = right = 0
        planes = np.empty((3, end - above, right - left), np.float32)
        for y in range(above, end):
            k = y - above
            _picture_row(sites, colours, y, left, planes[0, k], planes[1, k], planes[2, k])
            _weigh(planes[0, k], planes[1, k], planes[2, k], weights[y, left:right])
        for y in range(first, last):
            if left < right:
                _sites_row(planes, above, rows, colours, y, out[y, left:right])
            out[y, :left] = out[y, right:] = 0
            _subtract(out[y], right_hand_side[y])


# not in the loops above: numba does not know there that the rows lie apart


@compiled(fastmath=True)
def _weigh(red: FloatImage, green: FloatImage, blue: FloatImage, weights: FloatImage) -> None:
    for x in range(weights.size):
        red[x], green[x], blue[x] = red[x] * weights[x], green[x] * weights[x], blue[x] * weights[x]


@compiled(fastmath=True)
def _subtract(row: FloatImage, other: FloatImage) -> None:
    for x in range(other.size):
        row[x] -= other[x]


@compiled(fastmath=True)
def _total(row: FloatImage) -> float:
    total = np.float32(0)
    for x in range(row.size):
        total += row[x]
    return float(total)
