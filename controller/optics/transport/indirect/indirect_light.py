"""Light that the local transport L does not know, G: camera image = K + (I + G) L p.

Most of it arrives by way of other surfaces. After its first bounce light does not remember which projector it came
from. So G acts on the direct camera image d = L p: (G d)(x) = S(x) up(F down(d))(x). Blocks of camera pixels give each
other light by F; S is what a camera pixel makes of the light that falls on it, and holds the paint
(docs/decisions/0014).

Where colours depend on the paint, what L says of them is corrected first, by D, a matrix of each camera pixel's three
channels (docs/decisions/0015). Then N spreads it under the surface (docs/decisions/0015): with
y = (I + N)(I + D) d, the camera sees y + S up F down y.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol, Self

import numpy as np
import numpy.typing as npt
from numba import prange

from controller.core.arrays import STRIP_ROWS, FloatImage, Mask, moved_to_file, strips
from controller.core.jit import compiled
from controller.optics.transport.indirect.blocks import between, down, down_adjoint, mixed, up, up_adjoint
from controller.optics.transport.indirect.surface_light import SurfaceLight

ROUNDS: Final = 30
CONVERGED: Final = 1e-4
"""Relative change of the direct light, at which it is known: the next one is a tenth of it."""
LEAST_VOLUME: Final = 0.02
"""Determinant of I + D: three colours that a paint makes nearly one are no nearer to one than this."""
LARGEST: Final = 1e4
"""Of a number of (I + D)^-1 - I: float16 ends at 65504."""

NOTHING: Final[FloatImage] = np.empty((0, 0, 3), np.float32)
"""A picture without rows, for a kernel where there is none."""
NO_MATRICES: Final[FloatImage] = np.empty((3, 3, 0, 0), np.float32)

Colours = npt.NDArray[np.floating[Any]]
"""A matrix for the colours of each pixel (3, 3, rows, columns); float16 where it is kept."""


class ReflectedLight(Protocol):
    """What solves ask of light by way of other surfaces; all images (rows, columns, 3), as of ``IndirectLight``."""

    def forward(self, direct: FloatImage, beside: FloatImage | None = None) -> FloatImage: ...

    def direct_target(self, total: FloatImage, *, reach: FloatImage | None = None) -> FloatImage: ...

    def arrays(self) -> dict[str, npt.NDArray[Any]]: ...


@dataclass(frozen=True, slots=True, eq=False)
class IndirectLight:
    """G of a stage.

    ``factors`` (blocks, blocks) float32: light that falls on a block (row) from the mean light of another (column)
    ``scale`` (rows, columns, 3) float32: S, 0 where the camera sees no indirect light
    ``lit`` (rows, columns) bool: camera pixels whose direct light the transport knows
    ``grid``: (rows, columns) of the blocks; ``side``: camera pixels along a block
    ``room`` like ``factors``: of light on surfaces that are none of the object; None: as of the object
    ``paint`` (3, 3, rows, columns): D, what is added to a camera channel (first axis) of each of them; None: nothing
    ``surface``: N; None where light leaves where it falls
    """

    factors: FloatImage
    scale: FloatImage
    lit: Mask
    grid: tuple[int, int]
    side: int
    room: FloatImage | None = None
    paint: Colours | None = None
    surface: SurfaceLight | None = None

    def forward(self, direct: FloatImage, beside: FloatImage | None = None) -> FloatImage:
        """G d: (rows, columns, 3) light of a direct camera image of that shape, as L says, that is not in it.

        Light that L says falls beside lit pixels is not thrown back.

        ``beside`` like ``direct``: light on surfaces of the room, which the transport does not know
        """
        if self.paint is None and self.surface is None:
            return self.scale * self.falling(direct, beside)
        painted, spread = self._own(direct)
        own = painted + spread
        return self.scale * self.falling(own, beside) + (own - direct)

    def painted(self, direct: FloatImage) -> FloatImage:
        """(I + D) d of a direct camera image (rows, columns, 3)."""
        return direct if self.paint is None else direct + _times(self.paint, direct)

    def unpainted(self) -> Colours | None:
        """(I + D)^-1 - I, (3, 3, rows, columns); None where D is nothing."""
        return None if self.paint is None else _inverse(self.paint)

    def _own(self, direct: FloatImage) -> tuple[FloatImage, FloatImage | np.float32]:
        """(I + D) d, and N of it."""
        painted = self.painted(direct)
        return painted, np.float32(0) if self.surface is None else self.surface.forward(painted)

    def _falling_shown(self, direct: FloatImage, reach: FloatImage) -> tuple[FloatImage, FloatImage]:
        """While what can be shown of ``direct`` is shown: the light that falls on blocks (rows of blocks, columns of
        blocks, 3), and the light (rows, columns, 3) that spreads under surfaces, without rows where none does.

        ``reach`` without rows: without a limit
        """
        if self.paint is None and self.surface is None:
            sums = displayable_sums(direct, reach, *self.grid, self.side)
            return self._from_blocks(sums.reshape(-1, 3) / np.float32(self.side**2)), NOTHING
        own = np.empty(direct.shape, np.float32)
        for rows in strips(len(own)):
            part = displayable(direct[rows], reach[rows] if len(reach) else None)
            own[rows] = part if self.paint is None else part + _times(self.paint[:, :, rows], part)
        spread = NOTHING if self.surface is None else self.surface.forward(own)
        if len(spread):
            own += spread
        return self._from_blocks(down(own, self.grid, self.side)), spread

    def _from_blocks(self, blocks: FloatImage) -> FloatImage:
        return np.ascontiguousarray(self.factors @ blocks, np.float32).reshape(*self.grid, 3)

    def falling(self, direct: FloatImage, beside: FloatImage | None = None) -> FloatImage:
        """up(F down(d)): (rows, columns, 3) light that falls on surfaces, before S."""
        # beside lit pixels the transport knows some of the light; ``beside`` has all of it
        known = np.where(self.lit[..., None], direct, np.float32(0))
        blocks = self.factors @ down(known, self.grid, self.side)
        if beside is not None:
            blocks = blocks + (self.factors if self.room is None else self.room) @ down(beside, self.grid, self.side)
        return up(blocks, self.grid, self.side, self.lit.shape)

    def adjoint(self, image: FloatImage) -> FloatImage:
        """G' r of a camera image (rows, columns, 3)."""
        blocks = self.factors.T @ up_adjoint(self.scale * image, self.grid, self.side)
        found = np.where(self.lit[..., None], down_adjoint(blocks, self.grid, self.side, self.lit.shape), np.float32(0))
        if self.surface is not None:
            found = found + self.surface.adjoint(found + image)
        return found if self.paint is None else found + _times(self.paint.swapaxes(0, 1), found + image)

    def direct_target(self, total: FloatImage, *, reach: FloatImage | None = None) -> FloatImage:
        """The direct light d on lit pixels with d + G d = ``total`` (rows, columns, 3) there; 0 elsewhere.

        It is negative where more indirect light falls than is wanted. No light is less than none, nor more than
        ``reach``, so that G takes no more than that of it.
        """
        total = np.ascontiguousarray(total, np.float32)
        most = NOTHING if reach is None else np.ascontiguousarray(reach, np.float32)
        unpainted = self.unpainted()
        direct = np.zeros(total.shape, np.float32)
        falling, pairs = np.zeros((*self.grid, 3), np.float32), list[tuple[FloatImage, FloatImage]]()
        size = self._approach(direct, total, unpainted, falling, NOTHING)
        for _ in range(ROUNDS):
            answer, spread = self._falling_shown(direct, most)
            pairs = [*pairs[-2:], (falling, answer)]
            falling = _where_they_lead(pairs)
            if self._approach(direct, total, unpainted, falling, spread) < CONVERGED * max(size, 1e-30):
                break
        return direct

    def _approach(
        self, direct: FloatImage, total: FloatImage, unpainted: Colours | None, falling: FloatImage, spread: FloatImage
    ) -> float:
        """Let ``direct`` be what is left of ``total`` beside other light; the largest change of a number."""
        change = 0.0
        # the matrices are as many numbers as three pictures, and are not kept as float32
        for rows in strips(len(direct), len(direct) if unpainted is None else STRIP_ROWS):
            matrices = NO_MATRICES if unpainted is None else unpainted[:, :, rows].astype(np.float32)
            found = approach(
                direct[rows], total[rows], self.scale[rows], self.lit[rows], falling, self.side,
                spread[rows] if len(spread) else NOTHING, matrices, rows.start,
            )  # fmt: skip
            change = max(change, float(found.max(initial=0)))
        return change

    def in_files(self, folder: Path) -> Self:
        """The same; what is large need not stay in memory, but in nameless files of ``folder``."""
        paint = None if self.paint is None else moved_to_file(self.paint, folder)
        surface = None if self.surface is None else self.surface.in_files(folder)
        return dataclasses.replace(self, scale=moved_to_file(self.scale, folder), paint=paint, surface=surface)

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """All that the products depend on, by name."""
        shape = np.array([*self.grid, self.side])
        paint = {} if self.paint is None else {"paint": self.paint}
        surface = {} if self.surface is None else self.surface.arrays()
        return {"factors": self.factors, "scale": self.scale, "lit": self.lit, "grid": shape} | paint | surface


def _where_they_lead(pairs: Sequence[tuple[FloatImage, FloatImage]]) -> FloatImage:
    """Where an array would be its own answer, by those that were tried and the answer to each (Anderson 1965)."""
    tried, given = (np.array(part) for part in zip(*pairs, strict=True))
    missed = (given - tried).reshape(len(pairs), -1)
    shares = np.linalg.lstsq(np.diff(missed, axis=0).T, missed[-1])[0]
    return np.asarray(given[-1] - np.tensordot(shares, np.diff(given, axis=0), axes=1), np.float32)


def _times(matrices: Colours, image: FloatImage) -> FloatImage:
    """Each pixel's matrix (3, 3, rows, columns) times its colour (rows, columns, 3)."""
    found = np.empty(image.shape, np.float32)
    for rows in strips(len(image)):
        for channel, row in enumerate(matrices[:, :, rows]):
            found[rows, :, channel] = sum(one * image[rows, :, other] for other, one in enumerate(row))
    return found


def _inverse(deviation: Colours) -> Colours:
    """(I + D)^-1 - I of each pixel, (3, 3, rows, columns), where there is one, by Cramer's rule."""
    found = np.empty(deviation.shape, np.float16)
    for rows in strips(deviation.shape[2]):
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


@compiled(parallel=True)
def approach(
    direct: FloatImage,
    total: FloatImage,
    scale: FloatImage,
    lit: Mask,
    blocks: FloatImage,
    side: int,
    spread: FloatImage,
    unpainted: FloatImage,
    first: int,
) -> FloatImage:
    """Let ``direct`` (rows, columns, 3) be what is left of ``total`` beside other light, where it is ``lit``.

    ``scale``, ``lit``: of ``IndirectLight``; ``blocks`` (rows of blocks, columns of blocks, 3): light that falls on
    blocks of ``side`` pixels; ``spread`` like ``direct``: light that comes out beside where it fell; none with 0 rows;
    ``unpainted`` (3, 3, rows, columns): what is added of each channel to another; none with 0 rows
    ``first``: row of the picture with which all of these but ``blocks`` begin

    Returns the largest change of a number in each row (rows,).
    """
    rows, columns = lit.shape
    changed = np.zeros(rows, np.float32)
    for y in prange(rows):
        above, below, down_share = between(first + y, side, blocks.shape[0])
        falling = np.empty(blocks.shape[1:], np.float32)
        for block in range(blocks.shape[1]):
            for c in range(3):
                falling[block, c] = mixed(blocks[above, block, c], blocks[below, block, c], down_share)
        largest = np.float32(0)
        left = np.zeros(3, np.float32)
        for x in range(columns):
            if not lit[y, x]:
                continue
            before, after, share = between(x, side, blocks.shape[1])
            for c in range(3):
                left[c] = total[y, x, c] - scale[y, x, c] * mixed(falling[before, c], falling[after, c], share)
                if spread.shape[0]:
                    left[c] -= spread[y, x, c]
            for c in range(3):
                found = left[c]
                if unpainted.shape[2]:
                    for other in range(3):
                        found += unpainted[c, other, y, x] * left[other]
                largest = max(largest, abs(found - direct[y, x, c]))
                direct[y, x, c] = found
        changed[y] = largest
    return changed


@compiled(parallel=True)
def displayable_sums(direct: FloatImage, reach: FloatImage, rows: int, columns: int, side: int) -> FloatImage:
    """(rows of blocks, columns of blocks, 3): sums of what can be shown of ``direct`` (rows, columns, 3).

    That is no less than none, and no more than ``reach`` like ``direct``; without an upper limit if that has 0 rows.
    """
    height, width, channels = direct.shape
    out = np.zeros((rows, columns, channels), np.float32)
    for row in prange(rows):
        for y in range(row * side, min(row * side + side, height)):
            for column in range(columns):
                for c in range(channels):
                    part = np.float32(0)
                    for x in range(column * side, min(column * side + side, width)):
                        shown = max(direct[y, x, c], np.float32(0))
                        part += min(shown, reach[y, x, c]) if reach.shape[0] else shown
                    out[row, column, c] += part
    return out
