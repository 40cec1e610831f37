"""Light that spreads under the surface, at each camera pixel: a part of G (``transport.indirect``)."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt

from controller.core.arrays import FloatImage, Mask, moved_to_file
from controller.optics.calibrate.values import SurfaceSpread
from controller.optics.transport.indirect.blocks import down, down_adjoint, up, up_adjoint

BLOCKS_A_DISTANCE: Final = 4.0
"""Diffused light is so smooth that this many values for each distance d say all of it."""
DARKEST: Final = 1e-3
"""Of the brightest white: darker paint throws nothing back that counts."""
LEAST_NEAR: Final = 1e-3
"""Share of a pixel's surroundings that is on the object; below it nothing is said."""


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceLight:
    """N x = s (W K (x / W) - x): the share s of light x leaves elsewhere, K is diffusion, and W the paint.

    ``share``: s; ``distance_px``: d of K = (1 - d^2 Laplacian)^-1, in camera pixels
    ``white`` (rows, columns, 3): light with all projectors at white, which stays as it is; 0: light does not spread
    ``near`` (rows, columns): K of the surface itself, so that no light is lost beyond its border
    """

    share: float
    distance_px: float
    white: FloatImage
    near: FloatImage

    @classmethod
    def of(cls, spread: SurfaceSpread, white: FloatImage, lit: Mask) -> Self:
        """``white`` (rows, columns, 3): direct light of all projectors; ``lit`` (rows, columns): the object."""
        surface = lit & (white > DARKEST * white.max(initial=0)).all(axis=2)
        kept = np.where(surface[..., None], white, 0).astype(np.float32)
        near = _diffused(surface[..., None].astype(np.float32), spread.camera_px)[..., 0]
        return cls(spread.share, spread.camera_px, kept, near)

    def forward(self, light: FloatImage) -> FloatImage:
        """N x of ``light`` (rows, columns, 3)."""
        found = np.empty(light.shape, np.float32)
        # One channel after the other: what is needed on the way is a third as large.
        for channel in range(3):
            white, one = self.white[..., channel : channel + 1], light[..., channel : channel + 1]
            there = white > 0
            falling = np.divide(one, white, out=np.zeros(white.shape, np.float32), where=there)
            leaving = _over(_diffused(falling, self.distance_px), self.near)
            del falling
            leaving *= white
            leaving -= one
            leaving *= np.float32(self.share)
            found[..., channel : channel + 1] = np.where(there, leaving, np.float32(0))
        return found

    def adjoint(self, image: FloatImage) -> FloatImage:
        """N' r of ``image`` (rows, columns, 3)."""
        there = self.white > 0
        back = _diffused(_over(self.white * image, self.near), self.distance_px, transposed=True)
        back = np.divide(back, self.white, out=np.zeros_like(self.white), where=there)
        return np.where(there, np.float32(self.share) * (back - image), np.float32(0))

    def in_files(self, folder: Path) -> Self:
        """The same, in nameless files of ``folder`` where that is worth it."""
        white, near = (moved_to_file(one, folder) for one in (self.white, self.near))
        return dataclasses.replace(self, white=white, near=near)

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """All that the products depend on, by name."""
        return {"spread": np.array([self.share, self.distance_px]), "spread_white": self.white}


def _over(image: FloatImage, near: FloatImage) -> FloatImage:
    return np.divide(image, near[..., None], out=np.zeros_like(image), where=near[..., None] > LEAST_NEAR)


def _diffused(image: FloatImage, distance_px: float, *, transposed: bool = False) -> FloatImage:
    """K of ``image`` (rows, columns, channels) by cosines: mirrored at the picture's edges."""
    rows, columns = image.shape[:2]
    side = max(1, round(distance_px / BLOCKS_A_DISTANCE))
    grid = (-(-rows // side), -(-columns // side))
    if side == 1:
        return _solved(image, distance_px)
    blocks = up_adjoint(image, grid, side) if transposed else down(image, grid, side)
    smooth = _solved(blocks.reshape(*grid, -1), distance_px / side).reshape(grid[0] * grid[1], -1)
    return down_adjoint(smooth, grid, side, image.shape) if transposed else up(smooth, grid, side, image.shape)


def _solved(values: FloatImage, distance: float) -> FloatImage:
    """``values`` may be used for something else."""
    from scipy import fft

    rows, columns = (2 - 2 * np.cos(np.pi * np.arange(n) / n) for n in values.shape[:2])
    left = (1 / (1 + distance**2 * (rows[:, None] + columns[None, :]))).astype(np.float32)[..., None]
    spectrum = fft.dctn(values, axes=(0, 1), norm="ortho", overwrite_x=True)
    spectrum *= left
    return np.asarray(fft.idctn(spectrum, axes=(0, 1), norm="ortho", overwrite_x=True), np.float32)
