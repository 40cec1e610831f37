"""Which panel pixels light a camera pixel, and how much of each of them it sees.

Each projector pixel is a square with a fill factor, blurred by a Gaussian that is narrow in focus and wider away from
the focal surface. Both separate into x and y, so a pixel's light at a point is a product of two differences of erf.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Final, Self

import numba
import numpy as np
import numpy.typing as npt
from scipy.special import erf

from hal.runtime.jit import compiled
from plugins.emulated.optics.rays import BEYOND_PX, SIGMA_STEP_PX

Floats = npt.NDArray[np.float32]
Integers = npt.NDArray[np.int32]

SUBPIXELS: Final = 128
REACH_SIGMAS: Final = 3.2
LARGEST_RADIUS: Final = 13
MARGIN_PX: Final = LARGEST_RADIUS + int(BEYOND_PX) + 1
LANES: Final = 8
"""Rows of weights are as long as a multiple of this, with zeros at their ends, so that a core takes eight at once."""
KEPT_BYTES: Final = 256 << 20
"""A projector's summed weights may take so much memory. Pixels beyond it are summed again for each frame."""
BOX_BYTES: Final = 16
MOST_STEPS: Final = 65535
"""The largest weight of a camera pixel, in its own steps."""


@functools.lru_cache(maxsize=4)
def pixel_profiles(fill_factor: float) -> tuple[Floats, Integers]:
    """Cross-sections of a blurred pixel: weights (256, SUBPIXELS, 2 * LARGEST_RADIUS + LANES), and radius (256,).

    The first index is the blur in SIGMA_STEP_PX, the second the position between two half pixels; of the third,
    LARGEST_RADIUS is the middle, and the last LANES - 1 are 0. The weights of an evenly lit image sum to 1 on average
    over positions; between narrow pixels the gap shows.
    """
    side = np.sqrt(fill_factor)
    sigma = np.maximum(np.arange(256), 1) * SIGMA_STEP_PX
    offset = (np.arange(SUBPIXELS) + 0.5) / SUBPIXELS - 0.5
    far = np.arange(-2 * LARGEST_RADIUS, 2 * LARGEST_RADIUS + 1)
    distance = offset[None, :, None] - far[None, None, :]
    scale = np.sqrt(2.0) * sigma[:, None, None]
    whole = (erf((distance + 0.5 * side) / scale) - erf((distance - 0.5 * side) / scale)) / (2.0 * side)
    radius = np.minimum(np.ceil(REACH_SIGMAS * sigma + 0.5 * side - 0.5), LARGEST_RADIUS).astype(np.int32)
    near = np.where(np.abs(far) <= radius[:, None, None], whole, 0.0)
    # What the cut takes from the tails goes back to the rest, so that an even image is not darker where blurred.
    near *= (whole.sum(axis=2) / np.maximum(near.sum(axis=2), 1e-30))[..., None]
    weights = np.pad(near[..., LARGEST_RADIUS:-LARGEST_RADIUS], ((0, 0), (0, 0), (0, LANES - 1)))
    return np.ascontiguousarray(weights, dtype=np.float32), radius


@dataclass(frozen=True, slots=True)
class LitSamples:
    """What a projector lights: for N samples in P camera pixels, in camera pixel order.

    ``starts`` (P + 1,) int32: a camera pixel's first sample; ``at_px`` (N, 2) float32: x, y in projector pixels;
    ``gain`` (N,) float32: light for each linear light 1; ``blur`` (N,) uint8: in SIGMA_STEP_PX;
    ``albedo`` (N, 3) float32: what the camera sees of that light
    """

    starts: Integers
    at_px: Floats
    gain: Floats
    blur: npt.NDArray[np.uint8]
    albedo: Floats

    def from_pixel(self, first: int) -> Self:
        """What the camera pixels from ``first`` on see; holds no memory if there are none."""
        n = self.starts[first]
        starts = np.asarray(self.starts[first:] - n, dtype=np.int32)
        at_px, gain, blur, albedo = self.at_px[n:], self.gain[n:], self.blur[n:], self.albedo[n:]
        if not gain.size:
            at_px, gain, blur, albedo = at_px.copy(), gain.copy(), blur.copy(), albedo.copy()
        return type(self)(starts, at_px, gain, blur, albedo)


@dataclass(frozen=True, slots=True)
class Footprints:
    """What a projector lights, with its weights summed over the samples of each camera pixel, as far as memory allows.

    A camera pixel's weights are those of a rectangle of panel pixels for each colour, which lie one behind the other
    in ``weights``. Summing them costs more than a frame; showing a frame through them costs a fraction of it. They are
    kept in steps of 1/65535 of the pixel's largest, which is far below any noise and half the memory.

    ``boxes`` (K, 4) int32: first row, first column, rows, columns (a multiple of LANES, or 0);
    ``offsets`` (K + 1,) int64: into ``weights``; ``weights`` uint16: (3, rows, columns) of each of the first K camera
    pixels; ``steps`` (K,) float32: what a weight of 1 stands for; ``rest``: the others' samples
    """

    boxes: Integers
    offsets: npt.NDArray[np.int64]
    weights: npt.NDArray[np.uint16]
    steps: Floats
    rest: LitSamples
    fill_factor: float

    @classmethod
    def of(cls, lit: LitSamples, fill_factor: float, *, most_bytes: int = KEPT_BYTES) -> Self:
        """Sum the weights of as many camera pixels as ``most_bytes`` have room for."""
        profiles, radii = pixel_profiles(fill_factor)
        boxes = _boxes(lit.starts[: 1 + most_bytes // BOX_BYTES], lit.at_px, lit.gain, lit.blur, radii)
        ends = np.cumsum(boxes[:, 2].astype(np.int64) * boxes[:, 3] * 3)
        kept = int(np.searchsorted(2 * ends, most_bytes, side="right"))
        offsets = np.concatenate([[0], ends[:kept]]).astype(np.int64)
        weights, steps = np.empty(int(offsets[-1]), dtype=np.uint16), np.empty(kept, dtype=np.float32)
        _sum_weights(
            lit.starts, lit.at_px, lit.gain, lit.blur, lit.albedo, profiles, radii, boxes[:kept], offsets, weights,
            steps,
        )  # fmt: skip
        return cls(boxes[:kept], offsets, weights, steps, lit.from_pixel(kept), fill_factor)

    def light(self, sent: Floats) -> Floats:
        """Light (P, 3) of each camera pixel for what the panel's pixels (rows, columns, 3) send out."""
        rows, columns = sent.shape[:2]
        frame = np.zeros((3, rows + 2 * MARGIN_PX, columns + 2 * MARGIN_PX + LANES - 1), dtype=np.float32)
        frame[:, MARGIN_PX:-MARGIN_PX, MARGIN_PX : MARGIN_PX + columns] = np.moveaxis(sent, 2, 0)
        kept, rest = len(self.boxes), self.rest
        out = np.empty((kept + len(rest.starts) - 1, 3), dtype=np.float32)
        _through_weights(frame, self.boxes, self.offsets, self.weights, self.steps, out[:kept])
        _through_samples(
            frame, rest.starts, rest.at_px, rest.gain, rest.blur, rest.albedo, *pixel_profiles(self.fill_factor),
            out[kept:],
        )  # fmt: skip
        return out


@compiled()
def _place(at_px: float) -> tuple[int, int]:
    """The pixel at a coordinate, and which of its SUBPIXELS."""
    pixel = int(np.floor(at_px + 0.5))
    return pixel, min(int((at_px - pixel + 0.5) * SUBPIXELS), SUBPIXELS - 1)


@compiled()
def _padded(length: int) -> int:
    """The next multiple of LANES."""
    return (length + LANES - 1) // LANES * LANES


@compiled(parallel=True)
def _boxes(starts: Integers, at_px: Floats, gain: Floats, blur: npt.NDArray[np.uint8], radii: Integers) -> Integers:
    """For each camera pixel first row, first column, rows and columns (P, 4) of the panel pixels that light it."""
    boxes = np.zeros((len(starts) - 1, 4), dtype=np.int32)
    for pixel in numba.prange(len(boxes)):
        top = left = 1 << 30
        bottom = right = -(1 << 30)
        for n in range(starts[pixel], starts[pixel + 1]):
            if gain[n] > 0.0:
                radius = radii[blur[n]]
                column, row = _place(at_px[n, 0])[0], _place(at_px[n, 1])[0]
                top, bottom = min(top, row - radius), max(bottom, row + radius + 1)
                left, right = min(left, column - radius), max(right, column + radius + 1)
        if bottom > top:
            boxes[pixel, 0], boxes[pixel, 1] = top, left
            boxes[pixel, 2], boxes[pixel, 3] = bottom - top, _padded(right - left)
    return boxes


@compiled(parallel=True, fastmath=True)
def _sum_weights(
    starts: Integers,
    at_px: Floats,
    gain: Floats,
    blur: npt.NDArray[np.uint8],
    albedo: Floats,
    profiles: Floats,
    radii: Integers,
    boxes: Integers,
    offsets: npt.NDArray[np.int64],
    weights: npt.NDArray[np.uint16],
    steps: Floats,
) -> None:
    """Fill ``weights`` and ``steps`` (see ``Footprints``) of the camera pixels in ``boxes``."""
    for pixel in numba.prange(len(boxes)):
        sums = np.zeros((3, boxes[pixel, 2], boxes[pixel, 3]), dtype=np.float32)
        for n in range(starts[pixel], starts[pixel + 1]):
            if gain[n] <= 0.0:
                continue
            column, x = _place(at_px[n, 0])
            row, y = _place(at_px[n, 1])
            radius = radii[blur[n]]
            side, first = 2 * radius + 1, LARGEST_RADIUS - radius
            across, down = profiles[blur[n], x, first : first + side], profiles[blur[n], y, first : first + side]
            top, left = row - radius - boxes[pixel, 0], column - radius - boxes[pixel, 1]
            for c in range(3):
                for j in range(side):
                    line, share = sums[c, top + j, left : left + side], gain[n] * albedo[n, c] * down[j]
                    for i in range(side):
                        line[i] += share * across[i]
        largest = np.float32(0.0)
        for value in sums.flat:
            largest = max(largest, value)
        steps[pixel] = largest / np.float32(MOST_STEPS)
        each = np.float32(MOST_STEPS) / largest if largest > 0.0 else np.float32(0.0)
        kept = weights[offsets[pixel] : offsets[pixel + 1]]
        for k, value in enumerate(sums.flat):
            kept[k] = np.uint16(value * each + np.float32(0.5))


@compiled(parallel=True, fastmath=True)
def _through_weights(
    frame: Floats,
    boxes: Integers,
    offsets: npt.NDArray[np.int64],
    weights: npt.NDArray[np.uint16],
    steps: Floats,
    out: Floats,
) -> None:
    """Light (K, 3) of the camera pixels in ``boxes`` for a frame (3, rows, columns) with MARGIN_PX of black around."""
    for pixel in numba.prange(len(boxes)):
        top, left, rows, columns = boxes[pixel]
        left += MARGIN_PX
        for c in range(3):
            total = np.float32(0.0)
            at = offsets[pixel] + c * rows * columns
            for j in range(rows):
                line, shares = frame[c, top + j + MARGIN_PX, left : left + columns], weights[at : at + columns]
                for i in range(columns):
                    total += np.float32(shares[i]) * line[i]
                at += columns
            out[pixel, c] = steps[pixel] * total


@compiled(parallel=True, fastmath=True)
def _through_samples(
    frame: Floats,
    starts: Integers,
    at_px: Floats,
    gain: Floats,
    blur: npt.NDArray[np.uint8],
    albedo: Floats,
    profiles: Floats,
    radii: Integers,
    out: Floats,
) -> None:
    """Light (P, 3) of each camera pixel: the sum over its samples of albedo x gain x the blurred frame."""
    for pixel in numba.prange(len(starts) - 1):
        total_red = total_green = total_blue = np.float32(0.0)
        for n in range(starts[pixel], starts[pixel + 1]):
            if gain[n] <= 0.0:
                continue
            column, x = _place(at_px[n, 0])
            row, y = _place(at_px[n, 1])
            radius = radii[blur[n]]
            side, first = 2 * radius + 1, LARGEST_RADIUS - radius
            columns, top, left = _padded(side), row - radius + MARGIN_PX, column - radius + MARGIN_PX
            across, down = profiles[blur[n], x, first : first + columns], profiles[blur[n], y]
            red = green = blue = np.float32(0.0)
            for j in range(side):
                reds = frame[0, top + j, left : left + columns]
                greens = frame[1, top + j, left : left + columns]
                blues = frame[2, top + j, left : left + columns]
                r = g = b = np.float32(0.0)
                for i in range(columns):
                    r += across[i] * reds[i]
                    g += across[i] * greens[i]
                    b += across[i] * blues[i]
                red += down[first + j] * r
                green += down[first + j] * g
                blue += down[first + j] * b
            total_red += gain[n] * albedo[n, 0] * red
            total_green += gain[n] * albedo[n, 1] * green
            total_blue += gain[n] * albedo[n, 2] * blue
        out[pixel, 0], out[pixel, 1], out[pixel, 2] = total_red, total_green, total_blue
