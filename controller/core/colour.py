"""Colour spaces of picture files, and how their numbers become the linear sRGB light that targets are made of.

Little CMS (by imagecodecs) reads ICC profiles. Whatever a file says of its colours becomes tables for its numbers.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from controller.core.arrays import Float64, FloatImage

ColourSpace: TypeAlias = Literal["srgb", "display-p3", "rec2020", "acescg", "aces2065-1"]
"""Names of ``colour`` in stage.toml."""

D65: Final = (0.3127, 0.3290)
ACES_WHITE: Final = (0.32168, 0.33767)
BRADFORD: Final = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
BROADCAST_GAMMA: Final = 2.4
"""ITU-R BT.1886, of displays for Rec. 2020."""


class Unsuitable(Exception):
    """A picture file that can't be used; the text completes "It can't be used: ..."."""


@dataclass(frozen=True, slots=True)
class Primaries:
    """CIE xy of red, green, blue and white; ``curve``: how whole numbers in a file hold its light, or their gamma."""

    red: tuple[float, float]
    green: tuple[float, float]
    blue: tuple[float, float]
    white: tuple[float, float]
    curve: Literal["srgb", "none"] | float = "none"


SRGB: Final = Primaries((0.64, 0.33), (0.30, 0.60), (0.15, 0.06), D65, "srgb")
ADOBE_RGB: Final = Primaries((0.64, 0.33), (0.21, 0.71), (0.15, 0.06), D65, 563 / 256)
SPACES: Final[dict[ColourSpace, Primaries]] = {
    "srgb": SRGB,
    "display-p3": Primaries((0.680, 0.320), (0.265, 0.690), (0.150, 0.060), D65, "srgb"),
    "rec2020": Primaries((0.708, 0.292), (0.170, 0.797), (0.131, 0.046), D65, BROADCAST_GAMMA),
    "acescg": Primaries((0.713, 0.293), (0.165, 0.830), (0.128, 0.044), ACES_WHITE),
    "aces2065-1": Primaries((0.7347, 0.2653), (0.0, 1.0), (0.0001, -0.077), ACES_WHITE),
}

Colours: TypeAlias = Primaries | bytes
"""What a file says of its colours: primaries and a curve, or an ICC profile."""


def srgb_to_linear(values: npt.NDArray[Any]) -> FloatImage:
    """Linear light of sRGB values (IEC 61966-2-1): floats in [0, 1], or integers over their type's whole range."""
    encoded = _as_unit(values)
    low = encoded / np.float32(12.92)
    high = ((np.maximum(encoded, 0) + np.float32(0.055)) / np.float32(1.055)) ** np.float32(2.4)
    return np.where(encoded <= 0.04045, low, high).astype(np.float32)


def linear_to_srgb(light: FloatImage) -> FloatImage:
    """sRGB values in [0, 1] of linear light, clipped to [0, 1]."""
    clipped = np.clip(light, 0, 1).astype(np.float32)
    high = np.float32(1.055) * clipped ** np.float32(1 / 2.4) - np.float32(0.055)
    return np.where(clipped <= 0.0031308, np.float32(12.92) * clipped, high).astype(np.float32)


def _as_unit(values: npt.NDArray[Any]) -> FloatImage:
    if np.issubdtype(values.dtype, np.integer):
        return values.astype(np.float32) / np.float32(np.iinfo(values.dtype).max)
    return values.astype(np.float32)


def to_linear_srgb(space: Primaries) -> Float64:
    """(3, 3): linear light of ``space`` to linear sRGB, whites alike. Raises Unsuitable.

    An EXR of CIE XYZ has the white (1/3, 1/3) by its numbers' definition, not because that looks white.
    """
    try:
        to_xyz, srgb = _to_xyz(space), _to_xyz(SRGB)
        is_xyz = np.allclose((space.red, space.green, space.blue), ((1, 0), (0, 1), (0, 0)), atol=1e-4)
        adapted = np.eye(3) if is_xyz else _adapted(_xyz(space.white), _xyz(D65))
        matrix = np.linalg.solve(srgb, adapted @ to_xyz)
    except (np.linalg.LinAlgError, ZeroDivisionError) as error:
        raise Unsuitable("its chromaticities are no colours") from error
    if not np.isfinite(matrix).all():
        raise Unsuitable("its chromaticities are no colours")
    return np.asarray(matrix)


def reflectance_to_camera(white: tuple[float, float], camera_to_xyz: Float64) -> Float64:
    """(3, 3): linear sRGB of a surface, as of D65, to camera RGB of the same surface under a light of CIE xy ``white``.

    ``camera_to_xyz`` (3, 3), as of ``Calibration``: equal camera values are grey under D65. The light changes the
    surface's colour as it changes that of white (Bradford); its luminance stays.
    """
    srgb = _to_xyz(SRGB)
    camera_to_srgb = np.linalg.solve(srgb, camera_to_xyz)
    camera_to_srgb /= camera_to_srgb.sum(axis=1, keepdims=True)
    under_light = np.linalg.solve(srgb, _adapted(_xyz(D65), _xyz(white)) @ srgb)
    return np.asarray(np.linalg.solve(camera_to_srgb, under_light))


def mixed(light: FloatImage, space: Primaries) -> FloatImage:
    """Linear sRGB (..., 3) of linear light (..., 3) in ``space``. Raises Unsuitable."""
    matrix = to_linear_srgb(space).astype(np.float32)
    return light if np.allclose(matrix, np.eye(3), atol=1e-6) else np.asarray(light @ matrix.T, np.float32)


def linear_light(values: npt.NDArray[Any], colours: Colours) -> FloatImage:
    """(rows, columns, 3) float32 linear sRGB of a file's numbers, uint8 or uint16.

    ``values`` (rows, columns, 1 or 3): grey, or red, green and blue. Light outside sRGB is below 0 or above 1.
    Raises Unsuitable.
    """
    if colours == SRGB:
        light = _curve(values.dtype, "srgb")[values]
        return light if light.shape[2] == 3 else np.repeat(light, 3, axis=2)
    tables = _tables(colours, values.dtype, values.shape[2])
    if isinstance(colours, bytes):
        # Where a profile is curves and a matrix, its channels add up; where it is a table of colours, they do not.
        sample = values.reshape(-1, values.shape[2])[:: max(1, values.size // 10_000)]
        if np.abs(_summed(sample, tables) - _by_profile(sample, colours)).max(initial=0) > 1e-4:
            return np.concatenate([_by_profile(row, colours)[None] for row in values])
    return _summed(values, tables)


def _summed(values: npt.NDArray[Any], tables: Sequence[FloatImage]) -> FloatImage:
    light: FloatImage = tables[0][values[..., 0]]
    for channel, table in enumerate(tables[1:], 1):
        light += table[values[..., channel]]
    return light


@functools.lru_cache(4)
def _tables(colours: Colours, dtype: np.dtype[Any], channels: int) -> Sequence[FloatImage]:
    """Linear sRGB (numbers, 3) float32 of each channel's numbers alone; summed they are the light of a colour."""
    if isinstance(colours, Primaries):
        light = _curve(dtype, colours.curve)[:, None] * to_linear_srgb(colours).T.astype(np.float32)[:, None, :]
        return list(light) if channels == 3 else [light.sum(axis=0)]
    numbers = np.arange(np.iinfo(dtype).max + 1, dtype=dtype)
    alone = np.zeros((channels, len(numbers), channels), dtype)
    alone[range(channels), :, range(channels)] = numbers
    light = _by_profile(alone.reshape(-1, channels), colours).reshape(channels, -1, 3)
    light[1:] -= light[0, 0]
    return list(light)


@functools.lru_cache(8)
def _curve(dtype: np.dtype[Any], curve: Literal["srgb", "none"] | float) -> npt.NDArray[np.float32]:
    numbers = np.arange(np.iinfo(dtype).max + 1, dtype=dtype)
    if curve == "srgb":
        return srgb_to_linear(numbers)
    return _as_unit(numbers) ** np.float32(1.0 if curve == "none" else curve)


def _by_profile(values: npt.NDArray[Any], profile: bytes) -> FloatImage:
    """Linear sRGB (n, 3) of (n, 1 or 3) numbers, by Little CMS, relative to white. Raises Unsuitable."""
    import imagecodecs

    grey = values.shape[1] == 1
    try:
        light = imagecodecs.cms_transform(
            np.ascontiguousarray(values[None, :, 0] if grey else values[None]), profile, _linear_srgb_profile(),
            colorspace="gray" if grey else "rgb", outcolorspace="rgb",
            outdtype="float32", intent=imagecodecs.CMS.INTENT.RELATIVE_COLORIMETRIC,
        )  # fmt: skip
    except (RuntimeError, ValueError) as error:
        raise Unsuitable("its colour profile (ICC) is damaged, or not made for its kind of pixels") from error
    if not np.isfinite(light).all():
        raise Unsuitable("its colour profile (ICC) is damaged")
    return np.asarray(light[0], np.float32)


@functools.cache
def _linear_srgb_profile() -> bytes:
    import imagecodecs

    corners = [value for corner in (SRGB.red, SRGB.green, SRGB.blue) for value in (*corner, 1.0)]
    return bytes(imagecodecs.cms_profile("rgb", whitepoint=[*D65, 1.0], primaries=corners, gamma=1.0))


def _to_xyz(space: Primaries) -> Float64:
    """(3, 3): linear red, green, blue to CIE XYZ, white at Y = 1."""
    columns = np.array([(x, y, 1 - x - y) for x, y in (space.red, space.green, space.blue)], np.float64).T
    return np.asarray(columns * np.linalg.solve(columns, _xyz(space.white)))


def _adapted(since: Float64, to: Float64) -> Float64:
    """(3, 3) on CIE XYZ: what looks white under the white ``since`` (XYZ) looks white under ``to`` (Bradford)."""
    scale = (BRADFORD @ to) / (BRADFORD @ since)
    return np.asarray(np.linalg.inv(BRADFORD) @ (scale[:, None] * BRADFORD))


def _xyz(xy: tuple[float, float]) -> Float64:
    x, y = xy
    return np.array([x / y, 1.0, (1 - x - y) / y])
