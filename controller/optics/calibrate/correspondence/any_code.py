"""Gray code and phase shift as other programs show them, to correspondences."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final

import cv2
import numba
import numpy as np
import numpy.typing as npt

from controller.core import channels
from controller.core.arrays import FloatImage, Mask
from controller.core.jit import compiled
from controller.optics.calibrate.correspondence.captures import check_still, inconsistent
from controller.optics.calibrate.values import Correspondence

SURE, CLEAR, POSSIBLE = 6.0, 1.75, 0.25
"""Of the noise: the least difference of a pixel that needs no neighbours; that shows the order; that counts."""
NEIGHBOURS: Final = 2
"""Camera px to each side. At least half of the pixels there have to agree."""
DIRECT: Final = 0.4
"""Of the largest difference: a smaller one in all finer bits is light from elsewhere, which only coarse bits change."""
WITHOUT_OPPOSITE: Final = 0.1
"""Of the largest difference: what noise and blur do where pictures have no opposites, which would show it."""
BESIDE, BLOCK_PX = 0.1, 15
"""Of the largest difference as near as this: compression and interpolation of colours spread as much."""
EMPTY: Final = 0.05
"""Of the strongest bit: a weaker one shows nothing."""
UNLIKE: Final = 0.15
"""Of the light: a picture and its opposite always add up to the same, up to noise and the lamp's flicker."""
SETTLED: Final = 1e-4
"""Of all pixels: fewer that lose their neighbours are not looked for."""
LEVELS: Final = 16
FEWEST: Final = 100
LINES: Final = 64
REACH: Final = 8
"""Camera px over which the direction of x and y is looked at."""
SOME: Final = 100_000


@dataclass(frozen=True, slots=True)
class Bits:
    """One coordinate in Gray code.

    ``pairs``: for each bit, coarsest first, its picture and the opposite one (or the threshold between dark and
    light), (rows, columns, 3) float32 linear light, NaN where clipped; ``cell_px``: projector pixels of the finest
    cell; ``offset_px``: of the code, where its first cell lies left of or above the picture; ``opposites``: whether
    pictures have them
    """

    pairs: Iterable[tuple[FloatImage, FloatImage]]
    cell_px: int = 1
    offset_px: int = 0
    opposites: bool = True


@dataclass(frozen=True, slots=True)
class Sinusoid:
    """One coordinate in shifted sinusoids: picture n shows A + B cos(2 pi x / period_px + phases_rad[n]).

    ``pictures``: (rows, columns, 3) float32, NaN where clipped, at least three
    """

    pictures: Iterable[FloatImage]
    phases_rad: list[float]
    period_px: float


def decode_any(
    bits: tuple[Bits, Bits],
    sinusoids: tuple[Sinusoid | None, Sinusoid | None],
    projector_px: tuple[int, int],
    *,
    mirrored: bool = False,
) -> Correspondence:
    """Where each camera pixel looks, from the Gray code of x and y; a sinusoid measures inside its period.

    The period of a sinusoid has to be at least two cells of the Gray code. Returns ``Correspondence``:
    ``modulation`` is the contrast of the sinusoids, 1 where there is none. A pixel is valid where each bit stands out
    of the noise, or where at least half of the pixels around it see almost the same projector pixel.

    Raises CalibrationError("captures-inconsistent") naming what is wrong with the pictures or their order.
    """
    codes = _read(bits[0], "x"), _read(bits[1], "y")
    sure = _certainty(codes)
    clear = sure > CLEAR
    if np.count_nonzero(clear) >= FEWEST and all(code.count for code in codes):
        check_still(codes[0].mean(), codes[1].mean(), "the pictures of x and of y")
    for axis in range(2):
        _check_order(codes[axis], clear, "xy"[axis])
    cells = [_binary(code.gray) for code in codes]
    sizes = [one.cell_px for one in bits]
    valid = _with_neighbours(cells, sure)
    found = int(np.count_nonzero(valid & clear))
    if np.count_nonzero(clear) >= FEWEST and found < 0.3 * np.count_nonzero(clear):
        raise inconsistent("the code jumps from pixel to pixel", "Give the bits in the order in which they were shown.")
    if not mirrored:
        _check_mirrored(cells, valid & clear)
    position = np.full((*valid.shape, 2), np.nan, np.float32)
    modulation = np.ones(valid.shape, np.float32)
    told = valid & clear
    for axis in range(2):
        _check_range(cells[axis][told] * sizes[axis], bits[axis], len(codes[axis].seen), projector_px[axis], "xy"[axis])
        middle = cells[axis] * np.float32(sizes[axis]) + np.float32((sizes[axis] - 1) / 2 - bits[axis].offset_px)
        position[..., axis] = middle
        valid &= (middle > -0.5) & (middle < projector_px[axis] - 0.5)
    for axis, wave in enumerate(sinusoids):
        if wave is None:
            continue
        turn, contrast = _phase(wave)
        middle, within = position[..., axis], turn * np.float32(wave.period_px)
        measured = within + np.float32(wave.period_px) * np.round((middle - within) / np.float32(wave.period_px))
        valid &= (contrast > 0) & (np.abs(measured - middle) <= sizes[axis] / 2 + wave.period_px / 8)
        modulation = np.minimum(modulation, contrast)
        position[..., axis] = measured
        valid &= (measured > -0.5) & (measured < projector_px[axis] - 0.5)
    position[~valid] = np.nan
    return Correspondence(position, np.where(valid, modulation, 0).astype(np.float32), valid)


@dataclass(slots=True)
class _Code:
    """``gray`` (rows, columns) int32; ``seen``: how strong each bit is. The others (rows, columns) float32.

    ``smallest`` and ``largest`` difference of a picture and its opposite, ``finer``: the largest without the coarsest
    bits; ``total`` and ``square``: sums over ``count`` pairs of what noise alone changes, which was ``last``
    """

    gray: npt.NDArray[np.int32]
    smallest: FloatImage
    largest: FloatImage
    finer: FloatImage
    total: FloatImage
    square: FloatImage
    last: FloatImage
    seen: list[float] = field(default_factory=list)
    count: int = 0

    def mean(self) -> FloatImage:
        return np.asarray(self.total / np.float32(self.count), np.float32)


def _read(bits: Bits, axis: str) -> _Code:
    code: _Code | None = None
    for number, (picture, opposite) in enumerate(bits.pairs):
        first, second = _light(picture), _light(opposite)
        difference = first - second
        if code is None:
            a, b, c, d, e = (np.zeros(difference.shape, np.float32) for _ in range(5))
            code = _Code(a.astype(np.int32), np.full_like(a, np.inf), a, b, c, d, e)
        size = np.abs(difference)
        code.gray = 2 * code.gray + (difference > 0)
        np.minimum(code.smallest, size, out=code.smallest)
        np.maximum(code.largest, size, out=code.largest)
        if number >= COARSE:
            np.maximum(code.finer, size, out=code.finer)
        code.seen.append(float(np.percentile(size.ravel()[:: max(1, size.size // SOME)], 99)))
        if bits.opposites:
            code.last = first + second
            code.total += code.last
            code.square += code.last * code.last
            code.count += 1
    assert code is not None
    for number, seen in enumerate(code.seen, 1):
        if seen < EMPTY * max(code.seen):
            raise inconsistent(
                f"the picture of bit {number} of {axis} and its opposite show the same",
                "Give two different files for it. If they are, the camera was late by one picture: take them again.",
            )
    return code


COARSE: Final = 3


def _light(picture: FloatImage) -> FloatImage:
    """(rows, columns) of three colours. Clipped light is at least full scale, so differences are at least as large."""
    light = np.asarray(cv2.transform(picture, np.full((1, 3), 1 / 3, np.float32)), np.float32)
    clipped = ~np.isfinite(light)
    if clipped.any():
        light[clipped] = channels.mean(np.where(np.isfinite(picture[clipped]), picture[clipped], np.float32(1)))
    return light


def _certainty(codes: tuple[_Code, _Code]) -> FloatImage:
    """(rows, columns): the smallest difference of all bits in standard deviations of its noise; 0 where it is unfit.

    A picture and its opposite add up to the same in each pair; what varies is noise. It is a function of the light.
    """
    smallest = np.minimum(codes[0].smallest, codes[1].smallest)
    largest = np.maximum(codes[0].largest, codes[1].largest)
    beside = np.float32(BESIDE) * cv2.dilate(largest, np.ones((BLOCK_PX, BLOCK_PX), np.uint8))
    count = codes[0].count + codes[1].count
    if count < 3:
        sure = smallest / np.maximum(np.float32(WITHOUT_OPPOSITE / CLEAR) * largest, np.float32(1e-9))
        sure[largest < np.maximum(beside, EMPTY * np.percentile(largest, 99))] = 0
        return np.minimum(sure, np.float32(SURE))  # by chance alone a pixel may look sure
    light = (codes[0].total + codes[1].total) / np.float32(count)
    variance = (codes[0].square + codes[1].square) / np.float32(count) - light * light
    variance = np.maximum(variance, 0) * np.float32(count / (count - 1))
    step = max(1, light.size // SOME)
    some, spread = light.ravel()[::step], variance.ravel()[::step]
    groups = np.array_split(np.argsort(some), LEVELS)
    levels, typical = ([float(np.median(of[group])) for group in groups] for of in (some, spread))
    lit = some > np.percentile(some, 90)
    unlike = codes[1].last - light
    shape = np.std(cv2.blur(unlike, (5, 5))) > 0.5 * np.std(unlike)  # noise has none
    if shape and np.median(np.sqrt(spread[lit])) > UNLIKE * np.median(largest.ravel()[::step][lit]):
        raise inconsistent(
            "pictures and their opposites do not add up to the same light",
            "Check that each pair holds the two pictures of one bit, and that the exposure is fixed. If so, the camera "
            "was late by one picture: take them again.",
        )
    # a pixel that varies much more than others of its light was not still
    variance = np.maximum(np.interp(light, levels, typical).astype(np.float32), variance / np.float32(3))
    sure = smallest / np.sqrt(np.maximum(variance, np.float32(1e-12)))
    sure[largest < beside] = 0
    for code in codes:
        if len(code.seen) > COARSE:
            sure[code.finer < DIRECT * code.largest] = 0
    return np.asarray(sure, np.float32)


def _binary(gray: npt.NDArray[np.int32]) -> npt.NDArray[np.int32]:
    cell = gray.copy()
    for shift in (16, 8, 4, 2, 1):
        cell ^= cell >> shift
    return cell


def _beside(cells: npt.NDArray[np.int32], clear: Mask) -> npt.NDArray[np.int32]:
    """(2, n): clear camera pixels, and the clear ones right of them and below, along some rows and columns."""
    pairs = []
    for axis in range(2):
        across = np.s_[:: max(1, clear.shape[axis] // LINES)]
        here = (across,) if axis == 0 else (slice(None), across)
        line, at = (one[here] if axis else one[here].T for one in (cells, clear))
        both = at[1:] & at[:-1]
        pairs.append(np.stack([line[:-1][both], line[1:][both]]))
    return np.concatenate(pairs, axis=1)


def _steps(pairs: npt.NDArray[np.int32]) -> npt.NDArray[np.int32]:
    """Cells from one pixel of each pair to the other, without a sign."""
    return np.asarray(np.abs(pairs[1] - pairs[0]), np.int32)


def _check_order(code: _Code, clear: Mask, axis: str) -> None:
    """Compare the code with what other orders of its pictures would give; the right one has the shortest steps."""
    bits, gray = len(code.seen), _beside(code.gray, clear)
    if gray.shape[1] < FEWEST:
        return
    gray = gray[:, gray[0] != gray[1]]  # what looks at one cell does so in every order
    steps = _steps(_binary(gray))
    orders = {"its bits begin with the finest": list(range(bits))[::-1]}
    for bit in range(1, bits):
        orders[f"bits {bit} and {bit + 1} are exchanged"] = [*range(bit - 1), bit, bit - 1, *range(bit + 1, bits)]
    others = {"all pictures and opposites are exchanged": gray ^ (2**bits - 1)}
    for bit in range(1, bits):
        others[f"the picture and the opposite of bit {bit + 1} are exchanged"] = gray ^ (1 << (bits - 1 - bit))
    for what, order in orders.items():
        others[what] = np.zeros_like(gray)
        for bit in order:
            others[what] = 2 * others[what] + ((gray >> (bits - 1 - bit)) & 1)
    best, fault = FEWEST // 2, ""
    for what, other in others.items():
        would = _steps(_binary(other))
        shorter, longer = int(np.count_nonzero(would < steps)), int(np.count_nonzero(would > steps))
        if shorter > 4 * longer and shorter - longer > best:
            best, fault = shorter - longer, what
    if fault:
        raise inconsistent(
            f"the code of {axis} jumps as if {fault}", "Correct the order of the files in captures.toml."
        )


def _check_range(seen_px: npt.NDArray[np.int32], bits: Bits, count: int, size_px: int, axis: str) -> None:
    if seen_px.size < FEWEST or np.mean((seen_px >= size_px + bits.offset_px) | (seen_px < bits.offset_px)) < 0.01:
        return
    low, high = (int(one) for one in np.percentile(seen_px, (0.5, 99.5)))
    spare = (2**count * bits.cell_px - size_px) // 2
    remedy = "Correct projector_px or cell_px, or write offset_px = [x, y] below [gray] if the code begins outside."
    if bits.offset_px != spare and low >= spare - 2 and high < spare + size_px + 2:
        remedy = (
            f"The code seems to be centred in its power of two: write offset_px with {spare} for {axis} below [gray]."
        )
    raise inconsistent(
        f"the code of {axis} reaches from {low} to {high}, and the projector has {size_px} px there", remedy
    )


def _check_mirrored(cells: list[npt.NDArray[np.int32]], valid: Mask) -> None:
    here, right, below = np.s_[:-REACH, :-REACH], np.s_[:-REACH, REACH:], np.s_[REACH:, :-REACH]
    at = valid[here] & valid[right] & valid[below]
    if np.count_nonzero(at) < FEWEST:
        return
    (x, x_down), (y, y_down) = (((one[right] - one[here])[at], (one[below] - one[here])[at]) for one in cells)
    if np.mean(np.sign(x * y_down - y * x_down)) > -0.6:
        return
    turned = np.abs(y).mean() + np.abs(x_down).mean() > np.abs(x).mean() + np.abs(y_down).mean()
    fault = "the picture is mirrored, as if the picture of the coarsest bit and its opposite were exchanged"
    raise inconsistent(
        "x and y seem to be exchanged" if turned else fault,
        "Correct the lists in captures.toml. If a mirror or a screen that is lit from behind turns the picture, write "
        "mirrored = true below [gray].",
    )


def _with_neighbours(cells: list[npt.NDArray[np.int32]], sure: FloatImage) -> Mask:
    """Where a pixel is sure alone, or most pixels around it look at almost the same cell."""
    within = []
    for cell in cells:
        steps = _steps(_beside(cell, sure > CLEAR))
        within.append(2 + 4 * int(np.ceil(np.median(steps))) if steps.size else 2)
    valid, fewer = sure > POSSIBLE, sure.size
    while fewer > sure.size * SETTLED:
        before = int(np.count_nonzero(valid))
        valid = _agreeing(cells[0], cells[1], valid, sure > SURE, within[0], within[1])
        fewer = before - int(np.count_nonzero(valid))
    return valid


@compiled(parallel=True)
def _agreeing(
    x: npt.NDArray[np.int32], y: npt.NDArray[np.int32], valid: Mask, sure: Mask, far_x: int, far_y: int
) -> Mask:
    rows, columns = valid.shape
    agree = sure.copy()
    for row in numba.prange(rows):
        for column in range(columns):
            if sure[row, column] or not valid[row, column]:
                continue
            count = -1
            for r in range(max(0, row - NEIGHBOURS), min(rows, row + NEIGHBOURS + 1)):
                for c in range(max(0, column - NEIGHBOURS), min(columns, column + NEIGHBOURS + 1)):
                    near = abs(x[r, c] - x[row, column]) <= far_x and abs(y[r, c] - y[row, column]) <= far_y
                    count += valid[r, c] and near
            agree[row, column] = 2 * count >= (2 * NEIGHBOURS + 1) ** 2 - 1
    return agree


def _phase(wave: Sinusoid) -> tuple[FloatImage, FloatImage]:
    """(rows, columns): the place within the period, in turns; and the contrast B / A, 0 to 1. By least squares.

    A colour that is clipped in one of the pictures does not count; where all are, the contrast is 0.
    """
    phases = np.asarray(wave.phases_rad, np.float64)
    basis = np.linalg.pinv(np.stack([np.ones_like(phases), np.cos(phases), -np.sin(phases)], axis=1))
    parts: list[FloatImage] = []
    for number, picture in enumerate(wave.pictures):
        parts = [
            np.asarray(np.float32(row[number]) * picture + (parts[k] if parts else 0), np.float32)
            for k, row in enumerate(basis)
        ]
    mean, cosine, sine = (channels.total(np.nan_to_num(part)) for part in parts)
    turn = np.arctan2(sine, cosine) / np.float32(2 * np.pi)
    return np.asarray(turn, np.float32), np.clip(np.hypot(cosine, sine) / np.maximum(mean, np.float32(1e-9)), 0, 1)
