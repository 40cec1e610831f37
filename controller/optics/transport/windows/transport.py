"""The light transport by camera samples: each has its own shares of the projector's pixels around where it looks.

T_n p = D ( w_n (.) G_n (p M_n') ). A row of G_n is the projector's blur around the phase map phi at one sample of the
camera: exp(-1/2 (phi - v)' S^-1 (phi - v)) over the projector pixels v, divided by its sum. w_n is the white image as
sampled, and D the interpolation of the camera's colours, exactly as the pictures were made (docs/decisions/0006).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from controller.core import channels
from controller.core.arrays import FloatImage, Mask
from controller.optics.calibrate.values import Calibration, PhaseMap
from controller.optics.transport.operator import FAINTEST, LightTransport
from controller.optics.transport.planes import CameraBox, image_planes
from controller.optics.transport.windows.build import build_windows
from controller.optics.transport.windows.matrix import SampleRows, window_rows, windows_of_sites
from controller.optics.transport.windows.mosaic import collect, interpolate, normal_residual
from controller.optics.transport.windows.products import adjoint_sites, even_gains, forward_sites
from controller.optics.transport.windows.profiles import (
    Profiles,
    SmallProfiles,
    Windows,
    build_profiles,
    build_small_profiles,
)

_scratch: list[FloatImage] = []


@contextmanager
def borrow(shape: tuple[int, ...]) -> Iterator[FloatImage]:
    """A float32 array with any content. A simultaneous caller gets another one; one is kept afterwards."""
    # pop and append of a list are atomic
    try:
        array = _scratch.pop()
    except IndexError:
        array = np.empty(0, np.float32)
    if array.shape != shape:
        array = np.empty(shape, np.float32)
    try:
        yield array
    finally:
        if not _scratch:
            _scratch.append(array)


WHOLE: Final = 0.998
"""A camera pixel is lit by a projector where the samples it is made of have windows for this part of its white."""
SMALLEST_MOSAIC: Final = 2


@dataclass(frozen=True, eq=False, repr=False)
class WindowTransport(LightTransport):
    """T by camera samples.

    ``windows``: each sample's shares; ``table``, ``small``: the profiles they are made of
    ``colours`` (2, 2) int64 of the camera's samples, or (0, 0) where each pixel has three of its own
    ``per_sum`` (3, pixels) float32: 1 / sum of a projector pixel's part in the picture, gains left out, or 0
    """

    windows: Windows
    table: Profiles
    small: SmallProfiles
    colours: npt.NDArray[np.int64]
    per_sum: FloatImage

    @classmethod
    def from_calibration(cls, calibration: Calibration) -> WindowTransport:
        """Build T from phase maps; the calibration is consistent, and every projector has one."""
        parts = calibration.projectors
        mosaic = calibration.mosaic is not None and min(calibration.object_mask.shape) >= SMALLEST_MOSAIC
        colours = np.asarray(calibration.mosaic, np.int64) if mosaic else np.zeros((0, 0), np.int64)
        maps = tuple(part.phase_map for part in parts if part.phase_map is not None)
        mixing = np.stack([part.radiometry.mixing for part in parts]).astype(np.float32)
        return cls.of(maps, tuple(part.white for part in parts), colours, calibration.object_mask, mixing)

    @classmethod
    def of(
        cls,
        maps: tuple[PhaseMap, ...],
        whites: tuple[FloatImage, ...],
        colours: npt.NDArray[np.int64],
        mask: Mask,
        mixing: FloatImage,
    ) -> WindowTransport:
        """From a phase map and a white image (rows, columns, 3) for each projector; ``mask``: the object."""
        # a pixel of the object is made of samples beside it, too
        near = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0 if colours.size else mask
        bright = tuple(near & (channels.largest(white) > FAINTEST * white.max(initial=0)) for white in whites)
        windows = build_windows(maps, whites, colours, bright, mixing)
        sizes = tuple((int(rows), int(columns)) for rows, columns in windows.size)
        lit = np.zeros((len(maps), *mask.shape), np.bool_)
        pixels = int(windows.start[-1])
        none = np.zeros((3, pixels), np.float32)
        made = cls(mixing, lit, none[0], sizes, windows, build_profiles(), build_small_profiles(), colours, none)
        light = np.empty((3, *mask.shape), np.float32)
        plain = np.broadcast_to(np.eye(3, dtype=np.float32), mixing.shape).copy()
        ones = np.ones((3, pixels), np.float32)
        for n, white in enumerate(whites):
            made._products(ones, plain, (n, n + 1), light)
            lit[n] = mask & bright[n] & np.all(light >= np.float32(WHOLE) * made._sampled(white), axis=0)
        del ones
        light[:] = 1
        per_sum = made._sums(light, (0, len(maps)))
        # 1 / a smaller sum, which only very sharp windows leave at a pixel beside them, would be infinite
        per_sum[per_sum < np.finfo(np.float32).tiny] = 0
        np.divide(1, per_sum, out=per_sum, where=per_sum > 0)
        return cls(mixing, lit, per_sum.max(axis=0), sizes, windows, made.table, made.small, colours, per_sum)

    def _products(self, p: FloatImage, mixing: FloatImage, projectors: tuple[int, int], out: FloatImage) -> None:
        if not self.colours.size:
            out[:] = 0
            forward_sites(self.windows, self.table, self.small, mixing, p, projectors, out.reshape(-1))
            return
        with borrow(self.camera_shape) as sites:
            sites[:] = 0
            forward_sites(self.windows, self.table, self.small, mixing, p, projectors, sites.reshape(-1))
            interpolate(sites, self.colours, out)

    def _sampled(self, white: FloatImage) -> FloatImage:
        """(3, rows, columns): a picture interpolated again from its own samples."""
        planes = image_planes(white)
        if not self.colours.size:
            return planes
        sites = np.empty(self.camera_shape, np.float32)
        for row in range(2):
            for column in range(2):
                sites[row::2, column::2] = planes[self.colours[row, column], row::2, column::2]
        interpolate(sites, self.colours, planes)
        return planes

    def _sums(self, image: FloatImage, projectors: tuple[int, int]) -> FloatImage:
        out = np.zeros((3, self.pixels), np.float32)
        plain = np.broadcast_to(np.eye(3, dtype=np.float32), self.mixing.shape).copy()
        even = self.windows._replace(gain=even_gains(self.windows, self.small, projectors))
        self._transposed(image, plain, even, projectors, out)
        return out

    def _transposed(
        self, picture: FloatImage, mixing: FloatImage, windows: Windows, projectors: tuple[int, int], out: FloatImage
    ) -> None:
        if not self.colours.size:
            samples = np.ascontiguousarray(picture).reshape(-1)
            adjoint_sites(windows, self.table, self.small, mixing, samples, projectors, out)
            return
        with borrow(self.camera_shape) as sites:
            collect(picture, self.colours, sites)
            adjoint_sites(windows, self.table, self.small, mixing, sites.reshape(-1), projectors, out)

    def forward_planes(
        self, p: FloatImage, *, projectors: tuple[int, int] | None = None, out: FloatImage | None = None
    ) -> FloatImage:
        out = np.empty((3, *self.camera_shape), np.float32) if out is None else out
        self._products(p, self.mixing, projectors or (0, len(self.sizes)), out)
        return out

    def adjoint_planes(
        self, r: FloatImage, *, projectors: tuple[int, int] | None = None, out: FloatImage | None = None
    ) -> FloatImage:
        out = np.zeros((3, self.pixels), np.float32) if out is None else out
        self._transposed(r, self.mixing, self.windows, projectors or (0, len(self.sizes)), out)
        return out

    @property
    def sensor_size(self) -> int:
        """How many samples the camera has: one a pixel with a mosaic, else three."""
        return int(self.lit[0].size) * (1 if self.colours.size else 3)

    def accumulate_forward(self, n: int, p: FloatImage, buffer: FloatImage) -> None:
        forward_sites(self.windows, self.table, self.small, self.mixing, p, (n, n + 1), buffer)

    def adjoint_of_buffer(self, n: int, buffer: FloatImage, out: FloatImage) -> None:
        adjoint_sites(self.windows, self.table, self.small, self.mixing, buffer, (n, n + 1), out)

    def normal_residual(
        self, buffer: FloatImage, weights: FloatImage, right_hand_side: FloatImage, out: FloatImage
    ) -> None:
        if not self.colours.size:
            super().normal_residual(buffer, weights, right_hand_side, out)
            return
        samples, rhs, residual = (part.reshape(self.camera_shape) for part in (buffer, right_hand_side, out))
        normal_residual(samples, self.colours, weights, rhs, residual)

    def right_hand_side(self, picture: FloatImage, weights: FloatImage) -> FloatImage:
        if not self.colours.size:
            return super().right_hand_side(picture, weights)
        out = np.empty(self.camera_shape, np.float32)
        collect(np.multiply(picture, weights, out=picture), self.colours, out)
        return out.reshape(-1)

    def gaussian_mean_planes(self, image: FloatImage, *, projectors: tuple[int, int] | None = None) -> FloatImage:
        chosen = projectors or (0, len(self.sizes))
        means = self._sums(np.ascontiguousarray(image), chosen)
        # the other projectors' pixels are 0 and have no memory yet
        span = slice(self.span(chosen[0]).start, self.span(chosen[1] - 1).stop)
        means[:, span] *= self.per_sum[:, span]
        return means

    def submatrix(
        self, box: CameraBox, pixels: npt.NDArray[np.int64], channels: tuple[int, ...]
    ) -> sp.csr_matrix[np.float64]:
        return window_rows(self._rows, self.colours, self.mixing, self.camera_shape, box, pixels, channels)

    @cached_property
    def _rows(self) -> SampleRows:
        return SampleRows(self.windows, self.table, self.small, windows_of_sites(self.windows, self.sensor_size))

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        own = ("mixing", "lit", "per_weight", "colours", "per_sum")
        return self.windows._asdict() | {name: getattr(self, name) for name in own}
