"""A sensor of its own for tests: light to raw samples with known noise, ceiling, black level and bad samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from controller.optics.capture.demosaic import SensorLevels
from controller.optics.capture.linearity import RawExposure

RGGB = np.array([[0, 1], [1, 2]])


@dataclass(frozen=True, slots=True)
class SensorModel:
    """``electrons`` of one raw step; ``black`` and ``ceiling`` in steps; ``bend``: share lost at the ceiling."""

    electrons: float = 9.0
    read_e: float = 9.0
    black: float = 128.0
    ceiling: float = 4095.0
    bend: float = 0.0

    @property
    def levels(self) -> SensorLevels:
        """As a file would tell them: black 128, white 4095, whatever is true."""
        return SensorLevels(RGGB, np.full((2, 2), 128.0), np.full((2, 2), 4095.0), np.full((2, 2), np.inf))

    @property
    def shot(self) -> float:
        return 1 / (self.electrons * 3967)

    @property
    def read(self) -> float:
        return self.read_e / (self.electrons * 3967)

    def expose(
        self, light: npt.NDArray[np.float64], exposure_s: float, seed: int, *, told_s: float | None = None
    ) -> RawExposure:
        """``light`` (rows, columns) in full scales (of 3967 steps) per second."""
        rng = np.random.default_rng(seed)
        electrons = rng.poisson(light * exposure_s * 3967 * self.electrons) + rng.normal(0, self.read_e, light.shape)
        steps = electrons / self.electrons
        share = np.clip(steps / (self.ceiling - self.black), 0, None)
        steps = steps * (1 - self.bend * np.clip((share - 0.7) / 0.3, 0, 1))
        samples = np.clip(np.rint(steps + self.black), 0, self.ceiling).astype(np.uint16)
        return RawExposure(samples, told_s if told_s is not None else exposure_s)


def textured(rows: int = 240, columns: int = 320, *, low: float = 0.05, high: float = 30.0) -> npt.NDArray[np.float64]:
    """Light that varies over decades, with stripes and some grain."""
    across = np.geomspace(low, high, columns)[None, :] * np.ones((rows, 1))
    grain = np.random.default_rng(5).uniform(0.9, 1.1, (rows, columns))
    stripes = 1 + 0.4 * np.sin(np.arange(rows) / 9)[:, None]
    return across * grain * stripes
