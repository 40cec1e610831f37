"""Colour spaces of picture files, and how they become the linear sRGB light that targets are made of.

A file's embedded ICC profile says its curves and its matrix (ICC.1:2022).
"""

from __future__ import annotations

import io
import struct
import warnings
import zlib
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


_HEADER, _ENTRY, _MOST_TAGS = 132, 12, 200
_PARAMETERS: Final = (1, 3, 4, 5, 7)
"""Numbers that a parametric curve of each type has."""
_AFTER_HEADER: Final = 33
"""Bytes of a PNG before its second chunk."""


class Unsuitable(Exception):
    """A picture that can't be a target; the text completes "It can't be used: ..."."""


@dataclass(frozen=True, slots=True)
class Profile:
    """``curves``: three tables (n,) float64 of linear light over the whole range; ``matrix`` (3, 3) to linear sRGB."""

    curves: tuple[Float64, Float64, Float64]
    matrix: Float64

    def decoded(self, values: npt.NDArray[Any]) -> FloatImage:
        """Linear sRGB (..., 3) of whole numbers (..., 3)."""
        unit = values / np.float64(np.iinfo(values.dtype).max)
        light = [
            np.interp(unit[..., c], np.linspace(0, 1, curve.size), curve) if curve.size > 1 else unit[..., c]
            for c, curve in enumerate(self.curves)
        ]
        return mixed(np.stack(light, axis=-1).astype(np.float32), self.matrix)


def embedded_profile(data: bytes) -> bytes | None:
    """The ICC profile of a PNG or JPEG; None without one.

    Raises Unsuitable for a picture of ink colours (CMYK), one that moves, and one that Pillow can't read.
    """
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # the size has been checked
            with Image.open(io.BytesIO(data)) as picture:
                mode, moves = picture.mode, getattr(picture, "is_animated", False)
                profile = picture.info.get("icc_profile")
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError, struct.error, zlib.error) as error:
        raise Unsuitable("it could not be decoded") from error
    if mode == "CMYK":
        raise Unsuitable("its colours are those of ink (CMYK), and light needs red, green and blue")
    if moves:
        raise Unsuitable("it moves (an animation), and a target is one still picture")
    return profile if isinstance(profile, bytes) and profile else None


def with_profile(png: bytes, profile: bytes) -> bytes:
    """A PNG without a profile, with this one."""
    body = b"iCCP" + b"profile\0\0" + zlib.compress(profile)
    chunk = struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
    return png[:_AFTER_HEADER] + chunk + png[_AFTER_HEADER:]


def read_profile(data: bytes) -> Profile:
    """The curves and the matrix of an ICC profile. Raises Unsuitable where it has none."""
    try:
        return _read(data)
    except (struct.error, ValueError, KeyError, IndexError, OverflowError, ZeroDivisionError) as error:
        raise Unsuitable("its colour profile (ICC) is damaged") from error


def _read(data: bytes) -> Profile:
    kind, connection, mark = data[16:20], data[20:24], data[36:40]
    (count,) = struct.unpack(">I", data[128:_HEADER])
    if mark != b"acsp" or count > _MOST_TAGS:
        raise ValueError("no profile")
    tags = {}
    for at in range(_HEADER, _HEADER + count * _ENTRY, _ENTRY):
        name, start, size = struct.unpack(">4sII", data[at : at + _ENTRY])
        tags[name] = data[start : start + size]
    if kind == b"GRAY" and b"kTRC" in tags:
        curve = _curve(tags[b"kTRC"])
        return Profile((curve, curve, curve), np.eye(3))
    needed = {b"rXYZ", b"gXYZ", b"bXYZ", b"rTRC", b"gTRC", b"bTRC"}
    if kind != b"RGB " or connection != b"XYZ " or not needed <= set(tags):
        raise Unsuitable("its colour profile (ICC) is not made of three curves and a matrix")
    columns = [np.array(struct.unpack(">3i", tags[name][8:20])) / 65536 for name in (b"rXYZ", b"gXYZ", b"bXYZ")]
    curves = (_curve(tags[b"rTRC"]), _curve(tags[b"gTRC"]), _curve(tags[b"bTRC"]))
    return Profile(curves, d50_to_linear_srgb() @ np.stack(columns, axis=1))


def _curve(tag: bytes) -> Float64:
    """(n,) linear light over the whole range; of size 1: the light is the number itself."""
    if tag[:4] == b"curv":
        (count,) = struct.unpack(">I", tag[8:12])
        numbers = np.frombuffer(tag[12 : 12 + 2 * count], ">u2").astype(np.float64)
        if numbers.size != count:
            raise ValueError("cut short")
        if count <= 1:
            return np.ones(1) if count == 0 else _range() ** (numbers[0] / 256)
        return numbers / 65535
    if tag[:4] != b"para":
        raise ValueError("no curve")
    (kind,) = struct.unpack(">H", tag[8:10])
    size = _PARAMETERS[kind]
    return _parametric(kind, [one / 65536 for one in struct.unpack(f">{size}i", tag[12 : 12 + 4 * size])])


def _parametric(kind: int, parameters: list[float]) -> Float64:
    """ICC.1, 10.18: a power above a threshold d, a line or a constant below."""
    gamma, a, b, c, d, e, f = (parameters + [0.0] * 7)[:7]
    x = _range()
    if kind == 0:
        a, b, c, d, e, f = 1.0, 0.0, 0.0, 0.0, 0.0, 0.0
    elif kind in (1, 2):
        constant = c if kind == 2 else 0.0
        c, d, e, f = 0.0, -b / a, constant, constant
    elif kind == 3:
        e = f = 0.0
    # What a damaged profile makes infinite is refused below.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        light = np.where(x >= d, np.maximum(a * x + b, 0) ** gamma + e, c * x + f)
    if not np.isfinite(light).all():
        raise ValueError("no curve")
    return np.asarray(np.clip(light, 0, 1))


def _range() -> Float64:
    """As many values as a file of 16 bits has."""
    return np.linspace(0, 1, 65536)
