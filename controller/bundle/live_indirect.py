"""Light by way of other surfaces, for live targets: what of it falls on blocks of the target, found by samples.

Part of the definition in ``live_maps`` (docs/reference/bundle-format.md, "Live section", docs/decisions/0014).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

ROUNDS: Final = 3
"""Each leaves about a fifth of the error of the one before: a surface throws back less than it gets."""
SAMPLES: Final = 64
"""Target pixels that stand for a block."""

Float = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class LiveIndirect:
    """The maps of indirect light.

    ``factors`` (blocks, blocks) float32: light that falls on a block (row) from the mean light of another (column)
    ``grid``: (rows, columns) of the blocks; ``side``: target pixels along a block
    ``places`` (samples, blocks, 2) uint16: (row, column) of the target pixels that stand for each block
    ``sampled`` (3, samples, blocks, 3) float32: what a sample makes of falling light, its black image, and the most
    direct light that it can have (0 where no projector lights it)
    ``surface`` (height, width, 3) float16: what a target pixel makes of falling light, over its base light
    """

    factors: Float
    grid: tuple[int, int]
    side: float
    places: npt.NDArray[np.uint16]
    sampled: Float
    surface: npt.NDArray[np.float16]

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """As a bundle holds them, by key."""
        return {
            "factors": self.factors, "grid": np.array(self.grid, np.uint16), "side": np.array([self.side], np.float32),
            "places": self.places, "sampled": self.sampled, "surface": self.surface,
        }  # fmt: skip

    def samples(self, image: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """(samples, blocks, channels): the pixels of a target (height, width, channels) that stand for blocks."""
        flat = self.places[..., 0].astype(np.int64) * image.shape[1] + self.places[..., 1]
        return np.asarray(image.reshape(-1, image.shape[-1]).take(flat, axis=0))

    def falling(self, light: Float) -> Float:
        """(grid rows, columns, 3): light that falls on blocks, of the wanted radiance (samples, blocks, 3) of samples.

        What falls is part of the wanted light, so that projectors make less.
        """
        surface, black, most = self.sampled
        above = light - black
        found: Float = np.zeros((len(self.factors), 3), np.float32)
        for _ in range(ROUNDS):
            direct = surface * found
            np.subtract(above, direct, out=direct)
            np.clip(direct, 0, most, out=direct)
            found = self.factors @ direct.mean(axis=0)
        return found.reshape(*self.grid, 3)

    def spread(self, falling: Float) -> Float:
        """``falling`` (grid rows, columns, 3) at all target pixels: (height, width, 3), between blocks' middles."""
        rows = self.across(falling)
        up, part = between(self.surface.shape[0], self.grid[0], self.side)
        return np.asarray(rows[up] + part[:, None, None] * (rows[np.minimum(up + 1, len(rows) - 1)] - rows[up]))

    def across(self, falling: Float) -> Float:
        """The same in the rows of blocks' middles: (grid rows, width, 3)."""
        left, part = between(self.surface.shape[1], self.grid[1], self.side)
        right = np.minimum(left + 1, self.grid[1] - 1)
        return np.asarray(falling[:, left] + part[:, None] * (falling[:, right] - falling[:, left]), np.float32)


def between(pixels: int, blocks: int, side: float) -> tuple[npt.NDArray[np.int32], Float]:
    """For each pixel of a row or column: the block before it, and the part of the way to the next; (pixels,) each."""
    at = np.clip((np.arange(pixels) - (side - 1) / 2) / side, 0, blocks - 1).astype(np.float32)
    first = np.minimum(at.astype(np.int32), max(blocks - 2, 0)).astype(np.int32)
    return first, (at - first).astype(np.float32)


def read_indirect(
    shaped: Callable[[str, tuple[int, ...], str], npt.NDArray[Any]], size: tuple[int, int]
) -> LiveIndirect:
    """From a bundle's arrays; ``shaped(key, shape, dtype)`` gives one of them, checked.

    ``size``: (height, width) of targets. Raises what ``shaped`` raises, and ValueError where numbers do not fit.
    """
    high, wide = (int(value) for value in shaped("grid", (2,), "u2"))
    side, blocks = float(shaped("side", (1,), "f4")[0]), high * wide
    places = shaped("places", (SAMPLES, blocks, 2), "u2")
    if not side > 0 or (places >= np.array(size)).any():
        raise ValueError("blocks or samples of indirect light lie outside the target")
    return LiveIndirect(
        shaped("factors", (blocks, blocks), "f4"), (high, wide), side, places,
        shaped("sampled", (3, SAMPLES, blocks, 3), "f4"), shaped("surface", (*size, 3), "f2"),
    )  # fmt: skip
