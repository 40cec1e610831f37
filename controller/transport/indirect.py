"""Light that the local transport L does not know, G: camera image = K + (I + G) L p.

Most of it arrives by way of other surfaces. After its first bounce light does not remember which projector it came
from. So G acts on the direct camera image d = L p: (G d)(x) = S(x) up(F down(d))(x). Blocks of camera pixels give each
other light by F; S is what a camera pixel makes of the light that falls on it, and holds the paint
(docs/decisions/0045).

Where colours depend on the paint, what L says of them is corrected first: G = D + S up F down (I + D), with D a matrix
of each camera pixel's three channels (docs/decisions/0099).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt

from controller.core.arrays import FloatImage, Mask

ROUNDS: Final = 30
ROWS_AT_ONCE: Final = 128
CONVERGED: Final = 1e-5
"""Relative change of the direct light, at which it is known."""
LEAST_VOLUME: Final = 0.02
"""Determinant of I + D: three colours that a paint makes nearly one are no nearer to one than this."""
LARGEST: Final = 1e4
"""Of a number of (I + D)^-1 - I: float16 ends at 65504."""

Colours = npt.NDArray[np.floating[Any]]
"""A matrix for the colours of each pixel (3, 3, rows, columns); float16 where it is kept."""


@dataclass(frozen=True, slots=True, eq=False)
class IndirectLight:
    """G of a stage.

    ``factors`` (blocks, blocks) float32: light that falls on a block (row) from the mean light of another (column)
    ``scale`` (rows, columns, 3) float32: S, 0 where the camera sees no indirect light
    ``lit`` (rows, columns) bool: camera pixels whose direct light the transport knows
    ``grid``: (rows, columns) of the blocks; ``side``: camera pixels along a block
    ``room`` like ``factors``: of light on surfaces that are none of the object; None: as of the object
    ``paint`` (3, 3, rows, columns): D, what is added to a camera channel (first axis) of each of them; None: nothing
    """

    factors: FloatImage
    scale: FloatImage
    lit: Mask
    grid: tuple[int, int]
    side: int
    room: FloatImage | None = None
    paint: Colours | None = None

    def forward(self, direct: FloatImage, beside: FloatImage | None = None) -> FloatImage:
        """G d: (rows, columns, 3) light of a direct camera image of that shape, as L says, that is not in it.

        ``beside`` like ``direct``: light on surfaces of the room, which the transport does not know
        """
        if self.paint is None:
            return self.scale * self.falling(direct, beside)
        more = _times(self.paint, direct)
        return self.scale * self.falling(direct + more, beside) + more

    def _of_surfaces(self, direct: FloatImage) -> FloatImage:
        painted = direct if self.paint is None else direct + _times(self.paint, direct)
        return self.scale * self.falling(painted)

    def falling(self, direct: FloatImage, beside: FloatImage | None = None) -> FloatImage:
        """up(F down(d)): (rows, columns, 3) light that falls on surfaces, before S."""
        blocks = self.factors @ down(direct, self.grid, self.side)
        if beside is not None:
            blocks = blocks + (self.factors if self.room is None else self.room) @ down(beside, self.grid, self.side)
        return up(blocks, self.grid, self.side, self.lit.shape)

    def adjoint(self, image: FloatImage) -> FloatImage:
        """G' r of a camera image (rows, columns, 3)."""
        blocks = self.factors.T @ up_adjoint(self.scale * image, self.grid, self.side)
        direct = down_adjoint(blocks, self.grid, self.side, self.lit.shape)
        return direct if self.paint is None else direct + _times(self.paint.swapaxes(0, 1), direct + image)

    def direct_target(self, total: FloatImage, *, reach: FloatImage | None = None) -> FloatImage:
        """The direct light d on lit pixels with d + G d = ``total`` (rows, columns, 3) there; 0 elsewhere.

        It is negative where more indirect light falls than is wanted. No light is less than none, nor more than
        ``reach``, so that G takes no more than that of it.
        """
        lit = self.lit[..., None]
        wanted = np.where(lit, total, 0).astype(np.float32)
        unpainted = None if self.paint is None else _inverse(self.paint)
        direct = wanted if unpainted is None else wanted + _times(unpainted, wanted)
        size = max(float(np.abs(wanted).max(initial=0)), 1e-30)
        for _ in range(ROUNDS):
            after = np.where(lit, wanted - self._of_surfaces(displayable(direct, reach)), 0)
            after = after if unpainted is None else after + _times(unpainted, after)
            change = float(np.abs(after - direct).max(initial=0))
            direct = after.astype(np.float32, copy=False)
            if change < CONVERGED * size:
                break
        return direct

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """All that the products depend on, by name."""
        shape = np.array([*self.grid, self.side])
        paint = {} if self.paint is None else {"paint": self.paint}
        return {"factors": self.factors, "scale": self.scale, "lit": self.lit, "grid": shape} | paint


def _times(matrices: Colours, image: FloatImage) -> FloatImage:
    """Each pixel's matrix (3, 3, rows, columns) times its colour (rows, columns, 3)."""
    found = np.empty(image.shape, np.float32)
    for channel, row in enumerate(matrices):
        found[..., channel] = sum(one * image[..., other] for other, one in enumerate(row))
    return found


def _inverse(deviation: Colours) -> Colours:
    """(I + D)^-1 - I of each pixel, (3, 3, rows, columns), where there is one, by Cramer's rule."""
    found = np.empty(deviation.shape, np.float16)
    for start in range(0, deviation.shape[2], ROWS_AT_ONCE):
        rows = slice(start, start + ROWS_AT_ONCE)
        first, second, third = deviation[:, :, rows].astype(np.float32) + np.eye(3, dtype=np.float32)[..., None, None]
        columns = [np.cross(one, other, axis=0) for one, other in ((second, third), (third, first), (first, second))]
        volume = np.sum(first * columns[0], axis=0)
        volume = np.where(np.abs(volume) < LEAST_VOLUME, np.copysign(np.float32(LEAST_VOLUME), volume), volume)
        inverse = np.stack(columns, axis=1) / volume - np.eye(3, dtype=np.float32)[..., None, None]
        found[:, :, rows] = np.clip(inverse, -LARGEST, LARGEST)
    return found


def displayable(direct: FloatImage, reach: FloatImage | None = None) -> FloatImage:
    """What can be shown of a direct image: no less than none, and no more than ``reach``."""
    return np.maximum(direct, 0) if reach is None else np.clip(direct, 0, reach)


def down(image: FloatImage, grid: tuple[int, int], side: int) -> FloatImage:
    """(blocks, 3): mean of each block of ``side`` x ``side`` pixels; what lies beyond the picture is 0."""
    first = np.add.reduceat(image, np.arange(0, image.shape[0], side), axis=0)
    sums = np.add.reduceat(first, np.arange(0, image.shape[1], side), axis=1)
    return np.asarray(sums.reshape(grid[0] * grid[1], -1) / np.float32(side * side), np.float32)


def down_adjoint(blocks: FloatImage, grid: tuple[int, int], side: int, shape: tuple[int, ...]) -> FloatImage:
    """The transpose of ``down``: (rows, columns, 3)."""
    whole = np.repeat(np.repeat(blocks.reshape(*grid, -1), side, axis=0), side, axis=1)
    return np.asarray(whole[: shape[0], : shape[1]] / np.float32(side * side), np.float32)


def up(blocks: FloatImage, grid: tuple[int, int], side: int, shape: tuple[int, ...]) -> FloatImage:
    """(rows, columns, 3): values of blocks, interpolated between their middles."""
    # OpenCV's linear enlargement is that of ``_between``, and takes a tenth of the time of its products.
    size_px = (grid[1] * side, grid[0] * side)
    whole = cv2.resize(np.ascontiguousarray(blocks.reshape(*grid, -1)), size_px, interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(whole[: shape[0], : shape[1]], np.float32).reshape(*shape[:2], -1)


def down_up(grid: tuple[int, int], side: int, shape: tuple[int, ...]) -> Callable[[FloatImage], FloatImage]:
    """down(up(blocks)), without the picture of ``shape`` between them; blocks (blocks, 3)."""
    rows, columns = (
        np.add.reduceat(_between(shape[n], grid[n], side), np.arange(0, shape[n], side), axis=0) / np.float32(side)
        for n in (0, 1)
    )

    def across(blocks: FloatImage) -> FloatImage:
        planes = np.moveaxis(blocks.reshape(*grid, -1), 2, 0)
        return np.asarray(np.moveaxis(rows @ planes @ columns.T, 0, 2).reshape(len(blocks), -1), np.float32)

    return across


def up_adjoint(image: FloatImage, grid: tuple[int, int], side: int) -> FloatImage:
    """The transpose of ``up``: (blocks, 3)."""
    down_, across = _between(image.shape[0], grid[0], side), _between(image.shape[1], grid[1], side)
    parts = [down_.T @ image[..., c] @ across for c in range(image.shape[2])]
    return np.asarray(np.stack(parts, axis=2).reshape(grid[0] * grid[1], -1), np.float32)


def _between(pixels: int, blocks: int, side: int) -> FloatImage:
    """(pixels, blocks): linear interpolation, constant beyond the outermost middles."""
    at = np.clip((np.arange(pixels) - (side - 1) / 2) / side, 0, blocks - 1)
    return np.asarray(np.maximum(1 - np.abs(at[:, None] - np.arange(blocks)), 0), np.float32)
