"""Base x scale at video rate (paper 3, eqs 4-6), at half the camera's resolution and in whole numbers.

What ``solve.appearance.scale_frames`` does exactly is here made cheap: the scale image C_s is made at half resolution,
softened by a box as wide as a projector pixel, and each projector pixel reads it once, bilinearly, where its metapixel
lies; the mixing and the projector's response follow in the same pass. Only projector pixels that light the object are
touched.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt
from numba import prange
from scipy import ndimage

from controller.arrays import ByteImage, Float64, FloatImage, Mask
from controller.calibrate.values import Calibration
from controller.compiled import compiled
from controller.errors import UsageError
from controller.solve.appearance import Base
from controller.solve.targets_values import srgb_to_linear
from controller.transport import LightTransport

STEPS: Final = 4095
"""The table from the root of light to device values has so many steps."""
ONE: Final = 16384
"""A scale of 1, as it is kept in 16 bits; four times that is the most."""

Words = npt.NDArray[np.uint16]


@dataclass(frozen=True, slots=True)
class _Projector:
    """What frames are made of.

    ``pixel`` (n,) int32 indices of the pixels that light something; ``at`` (n, 2) float32 half-size (x, y)
    ``mixed`` (n, 3): M p_b; ``unmix`` (3, 3); ``device`` (3, STEPS + 1) uint8
    """

    shape: tuple[int, int]
    pixel: npt.NDArray[np.int32]
    at: FloatImage
    mixed: FloatImage
    unmix: FloatImage
    device: ByteImage


class LiveScaler:
    """Frames of a stage for pictures of its camera's half size.

    ``size`` (width, height): what pictures must have
    """

    def __init__(self, calibration: Calibration, transport: LightTransport, base: Base, *, exposure: float) -> None:
        """``exposure``: the light of a picture's white, as ``solve.feasibility.choose_exposure`` finds it."""
        rows, columns = transport.shape
        self.size = max(columns // 2, 1), max(rows // 2, 1)
        self._zoom = self.size[0] / columns, self.size[1] / rows
        self.names = tuple(part.name for part in calibration.projectors)
        self._light = (np.float32(exposure) * srgb_to_linear(np.arange(256, dtype=np.uint8))).astype(np.float32)
        inverse = np.ascontiguousarray(np.moveaxis(base.inverse, 0, 2))
        present = _half((inverse > 0).astype(np.float32), self.size)
        # the mean over those pixels that have base light
        self._inverse = np.divide(_half(inverse, self.size), present, out=np.zeros_like(present), where=present > 0)
        self._black = _half(np.ascontiguousarray(calibration.black, np.float32), self.size)
        self._projectors = tuple(self._prepared(calibration, transport, base, n) for n in range(len(self.names)))
        self._soft = tuple(_box(transport, n, self._zoom) for n in range(len(self.names)))
        self._scale = np.zeros((self.size[1], self.size[0], 3), np.uint16)
        self._row_used = np.asarray(self._inverse.any(axis=(1, 2)))
        self._rim = _rim(present.min(axis=2) > 0, max(self._soft))

    def _prepared(self, calibration: Calibration, transport: LightTransport, base: Base, n: int) -> _Projector:
        span = transport.span(n)
        pixel = np.flatnonzero(transport.per_weight[span] > 0)
        y, x = np.mgrid[0 : transport.shape[0], 0 : transport.shape[1]].astype(np.float32)
        middles = transport.gaussian_mean_planes(np.stack([x, y, np.ones_like(x)]), projectors=(n, n + 1))[:, span]
        at = np.stack([(middles[i, pixel] + 0.5) * self._zoom[i] - 0.5 for i in range(2)], axis=1)
        mixed = (base.mixed[:, span] * (base.coverage[:, span] > 0))[:, pixel].T
        unmix = np.linalg.inv(transport.mixing[n].astype(np.float64)).astype(np.float32)
        device = _device_table(calibration.projectors[n].radiometry.response)
        return _Projector(
            transport.sizes[n], pixel.astype(np.int32), np.ascontiguousarray(at, np.float32),
            np.ascontiguousarray(mixed, np.float32), unmix, device,
        )  # fmt: skip

    def blank(self) -> dict[str, ByteImage]:
        """Black frames of the projectors' sizes, to be filled by ``frames``."""
        black = {}
        for name, part in zip(self.names, self._projectors, strict=True):
            black[name] = np.empty((*part.shape, 3), np.uint8)
            black[name][:] = part.device[:, 0]
        return black

    def frames(self, picture: ByteImage, into: dict[str, ByteImage]) -> None:
        """Write the 8-bit frames of a picture (half rows, half columns, 3), sRGB, to those of ``blank``.

        Raises UsageError("image-wrong-size").
        """
        if picture.shape != self._scale.shape or picture.dtype != np.uint8:
            raise UsageError(
                "image-wrong-size",
                what=f"A live picture is {' x '.join(map(str, picture.shape))}, not {self.size[0]} x {self.size[1]}.",
                remedy="Scale it to half the size of the camera's picture.",
            )
        _scale_image(
            np.ascontiguousarray(picture), self._light, self._inverse, self._black, self._row_used, self._scale
        )
        if self._rim.size:
            flat = self._scale.reshape(-1, 3)
            flat[self._rim[0]] = flat[self._rim[1]]
        softened: dict[int, Words] = {}
        for name, part, box in zip(self.names, self._projectors, self._soft, strict=True):
            if box not in softened:
                softened[box] = np.asarray(cv2.blur(self._scale, (box, box)), np.uint16) if box > 1 else self._scale
            out = into[name].reshape(-1, 3)
            _gather(softened[box], part.pixel, part.at, part.mixed, part.unmix, part.device, out)


def fitted(picture: ByteImage, size: tuple[int, int]) -> ByteImage:
    """A picture (rows, columns, 3) scaled to ``size`` (width, height)."""
    if picture.shape[1::-1] == size:
        return picture
    smaller = picture.shape[1] > size[0]
    return np.asarray(
        cv2.resize(picture, size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR), np.uint8
    )


def _half(image: FloatImage, size: tuple[int, int]) -> FloatImage:
    return np.ascontiguousarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float32)


def _rim(present: Mask, box: int) -> npt.NDArray[np.int64]:
    """(2, n): pixels beyond the edge of the base's light that a softening box reads, and what they are to repeat.

    So the edge of the object is not darkened by what lies beside it.
    """
    if not present.any():
        return np.zeros((2, 0), np.int64)
    distance, nearest = ndimage.distance_transform_edt(~present, return_indices=True)
    rim = np.flatnonzero((distance > 0) & (distance <= box + 2))
    row, column = (part.ravel()[rim].astype(np.int64) for part in nearest)
    return np.stack([rim, row * present.shape[1] + column])


def _box(transport: LightTransport, n: int, zoom: tuple[float, float]) -> int:
    """How wide a projector pixel is in the half picture: the odd box that is nearest to it."""
    pixels = max(int((transport.per_weight[transport.span(n)] > 0).sum()), 1)
    pitch = float(np.sqrt(transport.lit[n].sum() / pixels)) * zoom[0]
    return max(2 * round((pitch - 1) / 2) + 1, 1)


def _device_table(response: Float64) -> ByteImage:
    """(3, STEPS + 1): the device value nearest to the light (i / STEPS)^2."""
    light = (np.arange(STEPS + 1) / STEPS) ** 2
    table = np.empty((3, STEPS + 1), np.uint8)
    for c in range(3):
        middles = (response[c, 1:] + response[c, :-1]) / 2
        table[c] = np.searchsorted(middles, light)
    return table


@compiled(parallel=True, fastmath=True)
def _scale_image(
    picture: ByteImage,
    light: FloatImage,
    inverse: FloatImage,
    black: FloatImage,
    used: npt.NDArray[np.bool_],
    out: Words,
) -> None:
    rows, columns, _ = picture.shape
    one, most = np.float32(ONE), np.float32(65535)
    for y in prange(rows):
        if not used[y]:
            continue
        for x in range(columns):
            for c in range(3):
                above = max(light[picture[y, x, c]] - black[y, x, c], np.float32(0))
                out[y, x, c] = np.uint16(min(above * inverse[y, x, c] * one, most))


@compiled(parallel=True, fastmath=True)
def _gather(
    scale: Words,
    pixel: npt.NDArray[np.int32],
    at: FloatImage,
    mixed: FloatImage,
    unmix: FloatImage,
    device: ByteImage,
    out: ByteImage,
) -> None:
    rows, columns, _ = scale.shape
    steps, low, high = np.float32(STEPS), np.float32(0), np.float32(1)
    for i in prange(pixel.size):
        x = min(max(at[i, 0], low), np.float32(columns - 1))
        y = min(max(at[i, 1], low), np.float32(rows - 1))
        left, top = min(int(x), columns - 2), min(int(y), rows - 2)
        fx, fy = x - np.float32(left), y - np.float32(top)
        a, b = (high - fx) * (high - fy), fx * (high - fy)
        c, d = (high - fx) * fy, fx * fy
        unit = np.float32(1.0 / ONE)
        p = scale[top, left]
        q = scale[top, left + 1]
        r = scale[top + 1, left]
        s = scale[top + 1, left + 1]
        red = (a * p[0] + b * q[0] + c * r[0] + d * s[0]) * unit * mixed[i, 0]
        green = (a * p[1] + b * q[1] + c * r[1] + d * s[1]) * unit * mixed[i, 1]
        blue = (a * p[2] + b * q[2] + c * r[2] + d * s[2]) * unit * mixed[i, 2]
        v = pixel[i]
        for k in range(3):
            value = unmix[k, 0] * red + unmix[k, 1] * green + unmix[k, 2] * blue
            value = min(max(value, low), high)
            out[v, k] = device[k, int(np.sqrt(value) * steps + np.float32(0.5))]
