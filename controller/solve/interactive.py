"""Base times scale at interactive speed: from a float picture in memory to 8-bit frames (paper 3, eqs 4-6).

The scale image has no detail finer than a projector's pixels (paper 3.3), so it is made from means over blocks of
camera pixels nearly a projector pixel wide, and each projector pixel's mean of it is a Gaussian over four by four
such blocks. Base frames, colours, response and dither follow in the same pass. ``appearance.scale_frames`` is the
reference: it takes every camera sample with its own share.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from numba import prange

from controller.arrays import ByteImage, FloatImage, Mask
from controller.calibrate.values import Radiometry
from controller.capture.encoding import checked_response
from controller.compiled import compiled
from controller.errors import UsageError
from controller.solve.appearance import Base
from controller.solve.bounded import check_target
from controller.solve.dither import TILE, blue_noise
from controller.transport import LightTransport
from controller.transport.profiles import LANES, PHASES, Profiles, build_profiles
from controller.transport.window_lanes import small_sum
from controller.transport.windows import kind_of

BLOCKS_A_PIXEL: Final = 1.25
"""About so many blocks is a projector pixel wide, where there are enough camera pixels."""
SPREAD_PX2: Final = 0.2
"""Variance of a projector pixel's light, in projector pixels squared."""
MARGIN: Final = 4
"""Blocks around the picture that are 0, so that no window ends outside."""
LEVELS: Final = 4096
"""Steps of the table from the square root of light to device values; between them it is interpolated."""
LEAST_PART: Final = 0.02
"""A pixel less of whose window has base light stays dark."""


@dataclass(frozen=True, slots=True, eq=False)
class Interactive:
    """A base ready to be scaled on the clock.

    ``block``: camera pixels a block is wide; ``black``, ``inverse`` (3, block rows, block columns) the black image and
    1 / base light; ``at`` (pixels,) int32, ``across``, ``down`` uint16: each projector pixel's window in the blocks
    ``gain`` (3, pixels): M p_b over the part of the window that has base light; ``unmix`` (projectors, 3, 3)
    ``levels`` (projectors, 3, LEVELS + 2): continuous device value by the square root of light
    ``start``, ``sizes``: each projector's first pixel, and (rows, columns); ``scale``: room for the blocks
    """

    shape: tuple[int, int]
    block: int
    black: FloatImage
    inverse: FloatImage
    at: npt.NDArray[np.int32]
    across: npt.NDArray[np.uint16]
    down: npt.NDArray[np.uint16]
    gain: FloatImage
    unmix: FloatImage
    levels: FloatImage
    start: npt.NDArray[np.int64]
    sizes: tuple[tuple[int, int], ...]
    table: Profiles
    scale: FloatImage

    def frames(self, target: FloatImage, *, phases: Sequence[tuple[int, int]] | None = None) -> list[ByteImage]:
        """Device values (rows, columns, 3) uint8 of each projector for a radiance (rows, columns, 3) float32.

        ``phases``: where in the blue-noise tile each projector begins. Not for two threads at once: the blocks are kept
        between calls. Raises UsageError("image-wrong-size", "target-not-finite").
        """
        if target.shape != (*self.shape, 3):
            raise UsageError(
                "image-wrong-size",
                what=f"The target is {' x '.join(map(str, target.shape))} instead of {self.shape[0]} x "
                f"{self.shape[1]} x 3.",
                remedy="Make the target as large as this stage's camera image.",
            )
        picture = np.ascontiguousarray(target, np.float32)
        flat = picture.reshape(self.shape[0], -1)
        blocks = _blocks_of_two if self.block == 2 else _blocks
        if not blocks(flat, self.block, self.black, self.inverse, self.scale):
            raise UsageError(
                "target-not-finite",
                what="The target has pixels that are not finite numbers.",
                remedy="Replace NaN and infinite pixels, for example by 0 outside the object.",
            )
        made = []
        for n, (rows, columns) in enumerate(self.sizes):
            out = np.empty((rows, columns, 3), np.uint8)
            down, along = (17 * n, 29 * n) if phases is None else phases[n]
            windows = self.at, self.across, self.down, self.gain
            colours = self.unmix[n], self.levels[n], blue_noise()
            _show(self.scale, self.table, *windows, *colours, int(self.start[n]), down % TILE, along % TILE, out)
            made.append(out)
        return made


def interactive(
    transport: LightTransport, base: Base, black: FloatImage, radiometries: Sequence[Radiometry]
) -> Interactive:
    """Prepare ``base`` to be scaled on the clock.

    ``black`` (rows, columns, 3); one radiometry a projector. Raises UsageError("response-not-rising"), and as
    ``check_target`` for ``black``.
    """
    check_target(transport, black)
    pixels = transport.per_weight > 0
    area = _areas(transport, pixels)
    pitch = float(np.sqrt(area[pixels].min())) if pixels.any() else 1.0
    block = int(max(1, min(np.rint(pitch / BLOCKS_A_PIXEL), *transport.shape)))
    rows, columns = transport.shape[0] // block, transport.shape[1] // block
    base_light = _means(np.maximum(base.image - black, 0), block)
    present = _means(np.moveaxis(base.inverse > 0, 0, 2).astype(np.float32), block) > 0.5
    inverse = np.divide(1, base_light, out=np.zeros_like(base_light), where=present & (base_light > 0))
    table = build_profiles()
    side = columns + 2 * MARGIN
    at, across, down = _windows(transport, area, block, (rows, columns), table)
    scale = np.zeros((3, (rows + 2 * MARGIN) * side), np.float32)
    scale.reshape(3, -1, side)[:, MARGIN:-MARGIN, MARGIN:-MARGIN] = inverse > 0
    part = np.empty((3, transport.pixels), np.float32)
    _sums(scale, side, table, at, across, down, part)
    usable = (part > LEAST_PART) & pixels
    gain = np.divide(base.mixed, part, out=np.zeros_like(part), where=usable)
    scale[:] = 0
    unmix = np.stack([np.linalg.inv(M.astype(np.float64)) for M in transport.mixing]).astype(np.float32)
    levels = np.stack([_levels(r) for r in radiometries])
    start = np.array([transport.span(n).start for n in range(len(transport.sizes))], np.int64)
    shaped = scale.reshape(3, -1, side)
    kept = transport.shape, block, _means(black, block), inverse, at, across, down, gain, unmix, levels, start
    return Interactive(*kept, transport.sizes, table, shaped)


def _areas(transport: LightTransport, pixels: Mask) -> FloatImage:
    """(pixels,): how many camera pixels a pixel of its projector covers on average."""
    area = np.zeros(transport.pixels, np.float32)
    for n, lit in enumerate(transport.lit):
        count = int(np.count_nonzero(pixels[transport.span(n)]))
        area[transport.span(n)] = np.count_nonzero(lit) / count if count else 1.0
    return area


def _means(image: FloatImage, block: int) -> FloatImage:
    """(rows, columns, 3) to planes (3, block rows, block columns): means over blocks of camera pixels."""
    rows, columns = image.shape[0] // block, image.shape[1] // block
    whole = image[: rows * block, : columns * block].reshape(rows, block, columns, block, 3)
    return np.ascontiguousarray(np.moveaxis(whole.mean(axis=(1, 3), dtype=np.float32), 2, 0))


def _windows(
    transport: LightTransport, area: FloatImage, block: int, size: tuple[int, int], table: Profiles
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.uint16], npt.NDArray[np.uint16]]:
    """Where each projector pixel's window begins in the blocks with their margin, and its rows of the table."""
    y, x = np.mgrid[0 : transport.shape[0], 0 : transport.shape[1]].astype(np.float32)
    # the mean over three colours' samples places a pixel better than that of one
    mean_x, mean_y = (transport.gaussian_mean_planes(np.stack([v, v, v])).mean(axis=0) for v in (x, y))
    place = [((v + 0.5) / block - 0.5).astype(np.float64) for v in (mean_x, mean_y)]
    kinds = np.array([kind_of(float(v)) for v in np.linspace(0, 1, 65)])
    kinds = np.minimum(kinds, int(table.small[0]) - 1)
    # blocks are themselves means over an area
    variance = np.clip(SPREAD_PX2 * area / block**2 - 1 / 12, 0, 1)
    kind = kinds[np.rint(64 * variance).astype(np.int64)]
    found = []
    for v, most in zip(place, (size[1], size[0]), strict=True):
        inside = np.clip(v, -1.0, float(most))
        low = np.floor(inside)
        phase = np.minimum(((inside - low) * PHASES).astype(np.int64), PHASES - 1)
        found.append((low.astype(np.int64) - (LANES // 2 - 1) + MARGIN, (kind * PHASES + phase).astype(np.uint16)))
    (left, across), (top, down) = found
    return (top * (size[1] + 2 * MARGIN) + left).astype(np.int32), across, down


def _levels(radiometry: Radiometry) -> FloatImage:
    """(3, LEVELS + 2): the device value, with its fraction, whose light is (i / LEVELS) squared."""
    light = checked_response(radiometry.response).astype(np.float64)
    wanted = np.linspace(0, 1, LEVELS + 1) ** 2
    rows = []
    for channel in light:
        rising = np.flatnonzero(np.diff(channel, prepend=-1.0) > 0)
        rows.append(np.interp(wanted, channel[rising], rising))
    found = np.stack(rows)
    return np.concatenate([found, found[:, -1:]], axis=1).astype(np.float32)


@compiled(parallel=True)
def _blocks_of_two(picture: FloatImage, block: int, black: FloatImage, inverse: FloatImage, scale: FloatImage) -> bool:
    """Write max(mean of block - black, 0) inverse inside the margin; return whether all is finite."""
    rows, columns = black.shape[1:]
    good = np.ones(rows, np.bool_)
    quarter = np.float32(0.25)
    for y in prange(rows):
        a, b = picture[2 * y], picture[2 * y + 1]
        total = np.float32(0)
        for c in range(3):
            out, dark, factor = scale[c, y + MARGIN], black[c, y], inverse[c, y]
            for x in range(columns):
                k = 6 * x + c
                light = quarter * (a[k] + a[k + 3] + b[k] + b[k + 3])
                total += light * np.float32(0)
                out[x + MARGIN] = max(light - dark[x], np.float32(0)) * factor[x]
        good[y] = total == 0
    return bool(good.all())


@compiled(parallel=True)
def _blocks(picture: FloatImage, block: int, black: FloatImage, inverse: FloatImage, scale: FloatImage) -> bool:
    """The same for blocks of any size."""
    rows, columns = black.shape[1:]
    good = np.ones(rows, np.bool_)
    share = np.float32(1 / (block * block))
    for y in prange(rows):
        total = np.float32(0)
        for c in range(3):
            for x in range(columns):
                light = np.float32(0)
                for j in range(block):
                    for i in range(block):
                        light += picture[y * block + j, 3 * (x * block + i) + c]
                light *= share
                total += light * np.float32(0)
                scale[c, y + MARGIN, x + MARGIN] = max(light - black[c, y, x], np.float32(0)) * inverse[c, y, x]
        good[y] = total == 0
    return bool(good.all())


@compiled(parallel=True, fastmath=True)
def _sums(
    scale: FloatImage,
    side: int,
    table: Profiles,
    at: npt.NDArray[np.int32],
    across: npt.NDArray[np.uint16],
    down: npt.NDArray[np.uint16],
    out: FloatImage,
) -> None:
    """Each pixel's mean of ``scale`` (3, blocks), to ``out`` (3, pixels)."""
    for i in prange(at.size):
        for c in range(3):
            a, b = LANES * np.int64(across[i]), LANES * np.int64(down[i])
            out[c, i] = small_sum(scale[c], np.int64(at[i]), side, table.table, a, b)


@compiled(parallel=True, fastmath=True)
def _show(
    scale: FloatImage,
    table: Profiles,
    at: npt.NDArray[np.int32],
    across: npt.NDArray[np.uint16],
    down: npt.NDArray[np.uint16],
    gain: FloatImage,
    unmix: FloatImage,
    levels: FloatImage,
    noise: FloatImage,
    start: int,
    below: int,
    along: int,
    out: ByteImage,
) -> None:
    rows, columns, _ = out.shape
    side = scale.shape[2]
    flat = scale.reshape(3, -1)
    red, green, blue = flat[0], flat[1], flat[2]
    shares, top = table.table, np.float32(LEVELS)
    for y in prange(rows):
        for x in range(columns):
            i = start + y * columns + x
            k, a, b = np.int64(at[i]), LANES * np.int64(across[i]), LANES * np.int64(down[i])
            r = gain[0, i] * small_sum(red, k, side, shares, a, b)
            g = gain[1, i] * small_sum(green, k, side, shares, a, b)
            s = gain[2, i] * small_sum(blue, k, side, shares, a, b)
            for c in range(3):
                value = unmix[c, 0] * r + unmix[c, 1] * g + unmix[c, 2] * s
                step = top * np.sqrt(min(max(value, np.float32(0)), np.float32(1)))
                j = int(step)
                low = levels[c, j]
                level = low + (step - np.float32(j)) * (levels[c, j + 1] - low)
                # Channels read the tile at different places, or colours would speckle together as grey does.
                limit = noise[(y + below + 21 * c) & (TILE - 1), (x + along + 43 * c) & (TILE - 1)]
                out[y, x, c] = np.uint8(min(level + (np.float32(1) - limit), np.float32(255)))
