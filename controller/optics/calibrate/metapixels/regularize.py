"""Priority regularisation of metapixel centres, and small gaps closed (paper 4.2.4).

Its queue is a binary max-heap in arrays whose keys can change. ``heap[0]`` is the number of entries, which follow from
``heap[1]``; ``place[item]`` is where an item lies, 0 if it is not in; ``key[item]`` orders them. The caller changes
``key`` and then calls ``update``.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from controller.core.arrays import Float64, Mask
from controller.core.jit import compiled
from controller.optics.calibrate.values import Metapixels


@compiled()
def rebuild(key: Float64) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Heap and places of all items whose key is finite."""
    heap, place = np.zeros(key.size + 1, np.int64), np.zeros(key.size, np.int64)
    for item in range(key.size):
        if np.isfinite(key[item]):
            heap[0] += 1
            heap[heap[0]] = item
            place[item] = heap[0]
    for at in range(heap[0] // 2, 0, -1):
        _sink(heap, place, key, at)
    return heap, place


@compiled()
def pop(heap: npt.NDArray[np.int64], place: npt.NDArray[np.int64], key: Float64) -> int:
    """Take out the item with the largest key; the heap must not be empty."""
    top = heap[1]
    last = heap[heap[0]]
    heap[0] -= 1
    place[top] = 0
    if heap[0] > 0:
        heap[1] = last
        place[last] = 1
        _sink(heap, place, key, 1)
    return int(top)


@compiled()
def update(heap: npt.NDArray[np.int64], place: npt.NDArray[np.int64], key: Float64, item: int) -> None:
    """Put an item whose key changed where it belongs; one that is not in is added."""
    if place[item] == 0:
        heap[0] += 1
        heap[heap[0]] = item
        place[item] = heap[0]
    _rise(heap, place, key, place[item])
    _sink(heap, place, key, place[item])


@compiled()
def _rise(heap: npt.NDArray[np.int64], place: npt.NDArray[np.int64], key: Float64, at: int) -> None:
    while at > 1 and key[heap[at]] > key[heap[at // 2]]:
        _swap(heap, place, at, at // 2)
        at //= 2


@compiled()
def _sink(heap: npt.NDArray[np.int64], place: npt.NDArray[np.int64], key: Float64, at: int) -> None:
    while True:
        largest = at
        for child in (2 * at, 2 * at + 1):
            if child <= heap[0] and key[heap[child]] > key[heap[largest]]:
                largest = child
        if largest == at:
            return
        _swap(heap, place, at, largest)
        at = largest


@compiled()
def _swap(heap: npt.NDArray[np.int64], place: npt.NDArray[np.int64], one: int, other: int) -> None:
    heap[one], heap[other] = heap[other], heap[one]
    place[heap[one]], place[heap[other]] = one, other


LEAST_GAIN = 0.05
REACH = 4
"""How many projector pixels away a missing neighbour's replacement may be."""
JUMP = 3.0
"""Times the median spacing; neighbours farther apart per projector pixel are on another surface."""
MOVES_PER_PIXEL = 20


def regularize(
    metapixels: Metapixels, *, least_gain: float = LEAST_GAIN, jump: float | None = JUMP
) -> tuple[Metapixels, int]:
    """Move irregular metapixels to the mean of their eight neighbours, the most irregular first (paper 4.2.4).

    A pixel's regularity is its shortest over its longest distance to the eight neighbours' centres: rho' where it is,
    rho at the neighbours' mean. A max-heap on beta = rho - rho' gives the pixel that gains most; it is moved, and its
    and its neighbours' beta are renewed, until no gain exceeds ``least_gain``. A missing neighbour is replaced by the
    next one farther in the same direction, with the inverse of its distance in projector pixels as weight, so that
    the mean stays where it would be. A pixel that has none in some direction is at an edge or corner, and stays.

    Parameters
    ----------
    jump : neighbours farther away than this many median spacings count as missing, so that pixels at a depth edge
        are not drawn into the gap; None is the paper's rule to the letter

    Returns
    -------
    the metapixels with new centres (same validity and covariances), and how often a pixel was moved
    """
    centre = np.where(metapixels.valid[:, :, None], metapixels.centre_px, np.nan).astype(np.float64)
    limit = np.inf if jump is None else jump * typical_spacing_px(centre)
    count = int(np.count_nonzero(metapixels.valid))
    moves = int(_regularize(centre, metapixels.valid, limit, least_gain, MOVES_PER_PIXEL * count))
    return replace(metapixels, centre_px=centre.astype(np.float32)), moves


def typical_spacing_px(centre_px: npt.NDArray[np.floating]) -> float:
    """Median distance between adjacent centres in camera pixels; 1 where there are none."""
    across = np.hypot(*np.moveaxis(np.diff(centre_px, axis=1), 2, 0))
    down = np.hypot(*np.moveaxis(np.diff(centre_px, axis=0), 2, 0))
    apart = np.concatenate([across[np.isfinite(across)], down[np.isfinite(down)]])
    return float(np.median(apart)) if apart.size else 1.0


def fill_holes(metapixels: Metapixels, *, widest: int = REACH) -> Metapixels:
    """Give missing metapixels that have neighbours on opposite sides the linear interpolation between them.

    Only gaps of up to ``widest`` projector pixels within one surface are closed; what lies outside stays missing.
    """
    values = np.concatenate([metapixels.centre_px, metapixels.covariance_px2], axis=2).astype(np.float64)
    filled, valid = values.copy(), metapixels.valid.copy()
    limit = JUMP * typical_spacing_px(np.where(metapixels.valid[:, :, None], values[:, :, :2], np.nan))
    _fill(values, metapixels.valid, widest, limit, filled, valid)
    return Metapixels(filled[:, :, :2].astype(np.float32), filled[:, :, 2:].astype(np.float32), valid)


@compiled()
def _regularize(centre: Float64, valid: Mask, limit: float, least_gain: float, most_moves: int) -> int:
    rows, columns = valid.shape
    beta = np.full(rows * columns, -np.inf)
    around_px = np.empty((8, 3))
    near = np.empty(8, np.int64)
    for row in range(rows):
        for column in range(columns):
            if valid[row, column] and _neighbours(centre, valid, row, column, limit, around_px, near):
                beta[row * columns + column] = _gain(centre[row, column], around_px)
    heap, place = rebuild(beta)
    moves = 0
    while heap[0] > 0 and moves < most_moves:
        pixel = pop(heap, place, beta)
        if beta[pixel] <= least_gain:
            break
        row, column = pixel // columns, pixel % columns
        if not _neighbours(centre, valid, row, column, limit, around_px, near):
            continue
        centre[row, column] = _mean(around_px)
        moves += 1
        around = near.copy()
        beta[pixel] = _gain(centre[row, column], around_px)
        update(heap, place, beta, pixel)
        for other in around:
            r, c = other // columns, other % columns
            if _neighbours(centre, valid, r, c, limit, around_px, near):
                beta[other] = _gain(centre[r, c], around_px)
                update(heap, place, beta, int(other))
    return moves


@compiled()
def _neighbours(
    centre: Float64, valid: Mask, row: int, column: int, limit: float, found: Float64, near: npt.NDArray[np.int64]
) -> bool:
    """Centre and weight of the nearest valid pixel in each of eight directions; False when one has none."""
    rows, columns = valid.shape
    n = 0
    for dr in range(-1, 2):
        for dc in range(-1, 2):
            if dr == 0 and dc == 0:
                continue
            missing = True
            for k in range(1, REACH + 1):
                r, c = row + k * dr, column + k * dc
                if not (0 <= r < rows and 0 <= c < columns):
                    break
                if not valid[r, c]:
                    continue
                dx, dy = centre[r, c, 0] - centre[row, column, 0], centre[r, c, 1] - centre[row, column, 1]
                if np.sqrt((dx * dx + dy * dy) / (dr * dr + dc * dc)) / k > limit:
                    continue
                found[n, 0], found[n, 1], found[n, 2] = centre[r, c, 0], centre[r, c, 1], 1.0 / k
                near[n] = r * columns + c
                n += 1
                missing = False
                break
            if missing:
                return False
    return True


@compiled()
def _mean(found: Float64) -> Float64:
    mean, weights = np.zeros(2), 0.0
    for k in range(8):
        mean[0] += found[k, 2] * found[k, 0]
        mean[1] += found[k, 2] * found[k, 1]
        weights += found[k, 2]
    return mean / weights


@compiled()
def _rho(at: Float64, found: Float64) -> float:
    """Shortest over longest distance; a farther neighbour's is brought to one pixel by its weight."""
    shortest, longest = np.inf, 0.0
    for k in range(8):
        distance = found[k, 2] * np.hypot(found[k, 0] - at[0], found[k, 1] - at[1])
        shortest, longest = min(shortest, distance), max(longest, distance)
    return shortest / longest if longest > 0 else 1.0


@compiled()
def _gain(at: Float64, found: Float64) -> float:
    return _rho(_mean(found), found) - _rho(at, found)


@compiled()
def _fill(values: Float64, valid: Mask, widest: int, limit: float, filled: Float64, now_valid: Mask) -> None:
    rows, columns, width = values.shape
    for row in range(rows):
        for column in range(columns):
            if valid[row, column]:
                continue
            total, weights = np.zeros(width), 0.0
            for dr, dc in ((0, 1), (1, 0), (1, 1), (1, -1)):
                ahead = _steps_to_valid(valid, row, column, dr, dc, widest)
                back = _steps_to_valid(valid, row, column, -dr, -dc, widest)
                span = ahead + back
                if ahead == 0 or back == 0 or span > widest + 1:
                    continue
                one = values[row + ahead * dr, column + ahead * dc]
                other = values[row - back * dr, column - back * dc]
                apart = np.hypot(one[0] - other[0], one[1] - other[1]) / np.sqrt(dr * dr + dc * dc)
                if apart > limit * span:
                    continue
                total += (one * back + other * ahead) / span / span
                weights += 1.0 / span
            if weights > 0:
                filled[row, column] = total / weights
                now_valid[row, column] = True


@compiled()
def _steps_to_valid(valid: Mask, row: int, column: int, dr: int, dc: int, widest: int) -> int:
    """Steps to the first valid pixel in a direction, 0 for none within ``widest``."""
    for k in range(1, widest + 1):
        r, c = row + k * dr, column + k * dc
        if not (0 <= r < valid.shape[0] and 0 <= c < valid.shape[1]):
            return 0
        if valid[r, c]:
            return k
    return 0
