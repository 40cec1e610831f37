"""A JPEG camera of its own for tests: any rising curve above a black, noise in values, quantisation, no vignetting."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy.interpolate import PchipInterpolator

from controller.core.arrays import Float64

SHAPE_PX = (200, 260)
EXPOSURES_S = tuple(2.0**stop for stop in range(-7, 2))
KNOTS = 8


@dataclass(frozen=True, slots=True)
class CameraModel:
    """``black`` (red, green, blue) values that stand for no light; ``noise`` standard deviation in values.

    The curve goes through random rising points around ``light ** (1 / gamma)``; ``bend`` 0..1: how far from it.
    """

    black: tuple[int, int, int] = (0, 0, 0)
    gamma: float = 2.2
    bend: float = 0.5
    noise: float = 0.7
    seed: int = 0

    def curve(self, light: Float64) -> Float64:
        """(...) share of the way from black to 255 for light 0..1."""
        steps = np.random.default_rng(self.seed).uniform(1 - self.bend, 1 + self.bend, KNOTS)
        bent = PchipInterpolator(np.linspace(0, 1, KNOTS + 1), np.append(0, np.cumsum(steps)) / steps.sum())
        return np.asarray(bent(np.clip(light, 0, 1) ** (1 / self.gamma)), np.float64)

    def light_of_values(self) -> Float64:
        """(3, 256) true light of each value, 0 up to black."""
        grid = np.linspace(0, 1, 20_001) ** self.gamma
        share = [(np.arange(256) - black) / (255 - black) for black in self.black]
        return np.stack([np.interp(one, self.curve(grid), grid) for one in share])

    def takes(self, scene: Float64, exposure_s: float, seed: int) -> npt.NDArray[np.uint8]:
        black = np.array(self.black, np.float64)
        value = black + (255 - black) * self.curve(scene * exposure_s)
        noisy = value + np.random.default_rng((self.seed, seed)).normal(0, self.noise, value.shape)
        return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)

    def series(self, scene: Float64) -> list[npt.NDArray[np.uint8]]:
        return [self.takes(scene, exposure_s, n) for n, exposure_s in enumerate(EXPOSURES_S)]


def lit_scene(seed: int = 0, *, dark_share: float = 0.3) -> Float64:
    """(rows, columns, 3) smooth light over two decades; the left ``dark_share`` of it gets none."""
    noise = np.random.default_rng(seed).standard_normal((*SHAPE_PX, 3)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 9)
    light = np.asarray(np.exp(1.3 * smooth / smooth.std()) * 1.5, np.float64)
    light[:, : round(dark_share * SHAPE_PX[1])] = 0
    return light
