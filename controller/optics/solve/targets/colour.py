"""Colour spaces of picture files, and how they become the linear sRGB light that targets are made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from controller.core.arrays import Float64, FloatImage
from controller.optics.solve.targets.values import srgb_to_linear

ColourSpace: TypeAlias = Literal["srgb", "display-p3", "rec2020", "acescg", "aces2065-1"]
"""Names of ``colour`` in stage.toml."""

D65: Final = (0.3127, 0.3290)
D50_XYZ: Final = (0.9642, 1.0, 0.8249)
"""The white of ICC profiles' connection space (ICC.1, 7.2.16)."""
ACES_WHITE: Final = (0.32168, 0.33767)
BRADFORD: Final = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
BROADCAST_GAMMA: Final = 2.4
"""ITU-R BT.1886, of displays for Rec. 2020."""


@dataclass(frozen=True, slots=True)
class Primaries:
    """CIE xy of red, green, blue and white; ``curve``: how whole numbers in a file hold its light."""

    red: tuple[float, float]
    green: tuple[float, float]
    blue: tuple[float, float]
    white: tuple[float, float]
    curve: Literal["srgb", "gamma", "none"] = "none"


SPACES: Final[dict[ColourSpace, Primaries]] = {
    "srgb": Primaries((0.64, 0.33), (0.30, 0.60), (0.15, 0.06), D65, "srgb"),
    "display-p3": Primaries((0.680, 0.320), (0.265, 0.690), (0.150, 0.060), D65, "srgb"),
    "rec2020": Primaries((0.708, 0.292), (0.170, 0.797), (0.131, 0.046), D65, "gamma"),
    "acescg": Primaries((0.713, 0.293), (0.165, 0.830), (0.128, 0.044), ACES_WHITE),
    "aces2065-1": Primaries((0.7347, 0.2653), (0.0, 1.0), (0.0001, -0.077), ACES_WHITE),
}


def to_xyz(space: Primaries) -> Float64:
    """(3, 3): linear red, green, blue to CIE XYZ, white at Y = 1."""
    columns = np.stack([_xyz(one) for one in (space.red, space.green, space.blue)], axis=1)
    return np.asarray(columns * np.linalg.solve(columns, _xyz(space.white)))


def adapted(since: Sequence[float] | Float64, to: Sequence[float] | Float64) -> Float64:
    """(3, 3) on CIE XYZ: what looks white under the white ``since`` (XYZ) looks white under ``to`` (Bradford)."""
    scale = (BRADFORD @ np.asarray(to, np.float64)) / (BRADFORD @ np.asarray(since, np.float64))
    return np.asarray(np.linalg.inv(BRADFORD) @ (scale[:, None] * BRADFORD))


def to_linear_srgb(space: Primaries) -> Float64:
    """(3, 3): linear light of ``space`` to linear sRGB, whites alike."""
    return np.asarray(np.linalg.solve(to_xyz(SPACES["srgb"]), adapted(_xyz(space.white), _xyz(D65)) @ to_xyz(space)))


def d50_to_linear_srgb() -> Float64:
    """(3, 3): CIE XYZ of an ICC profile (D50) to linear sRGB."""
    return np.asarray(np.linalg.solve(to_xyz(SPACES["srgb"]), adapted(D50_XYZ, _xyz(D65))))


def decoded(values: npt.NDArray[Any], space: Primaries) -> FloatImage:
    """Linear sRGB light (..., 3) of a file's red, green, blue (..., 3): whole numbers by the space's curve."""
    if not np.issubdtype(values.dtype, np.integer):
        light = values.astype(np.float32)
    elif space.curve == "gamma":
        light = (values / np.float32(np.iinfo(values.dtype).max)).astype(np.float32) ** np.float32(BROADCAST_GAMMA)
    else:
        light = srgb_to_linear(values)
    return light if space == SPACES["srgb"] else mixed(light, to_linear_srgb(space))


def mixed(light: FloatImage, matrix: Float64) -> FloatImage:
    """``matrix`` @ each colour of (..., 3)."""
    return np.asarray(light @ matrix.T.astype(np.float32), np.float32)


def _xyz(xy: tuple[float, float]) -> Float64:
    x, y = xy
    return np.array([x / y, 1.0, (1 - x - y) / y])
