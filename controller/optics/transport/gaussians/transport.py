"""The light transport where only metapixels are known: Gaussians in the camera image, normalised (paper 4.2.3).

The camera's own blur H (its optics and the interpolation of its colours) comes after the object's colour: at a painted
edge a camera pixel's light is an average over places of different colour. So where H is known, it stands in the shares:
G_n p = H (a_n (.) g_n p) / H (a_n (.) g_n 1), with g_n the shares on the object and a_n the white image before the blur
(docs/decisions/0006).
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from numba import prange

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, Mask
from controller.core.jit import compiled
from controller.optics.calibrate.values import Calibration, Metapixels
from controller.optics.transport.gaussians.patches import Patches, build_patches
from controller.optics.transport.gaussians.products import adjoint_planes, forward_planes, gaussian_sums, multiply_add
from controller.optics.transport.operator import FAINTEST, LightTransport
from controller.optics.transport.planes import CameraBox, image_planes
from controller.optics.transport.simd.gaussians import LANES

Pixels = npt.NDArray[np.int64]


def _shares(patches: Patches, pixels: Pixels, box: CameraBox) -> sp.csc_matrix[np.float64]:
    """(camera pixels of the box, projector pixels): the weights of the metapixels, before gain."""
    size = int((patches.rows[pixels].astype(np.int64) * patches.groups[pixels]).sum()) * LANES
    row, column, value = np.empty(size, np.int32), np.empty(size, np.int32), np.empty(size)
    count = _gather(patches, pixels, box, row, column, value)
    shape = ((box.bottom - box.top) * (box.right - box.left), pixels.size)
    return sp.csc_matrix((value[:count], (row[:count], column[:count])), shape=shape)


@compiled()
def _gather(
    patches: Patches,
    pixels: Pixels,
    box: CameraBox,
    row: npt.NDArray[np.int32],
    column: npt.NDArray[np.int32],
    value: Float64,
) -> int:
    top, left, bottom, right = box
    n = 0
    for i in range(pixels.size):
        v = pixels[i]
        k = np.int64(patches.first[v]) * LANES
        for y in range(patches.row[v], patches.row[v] + patches.rows[v]):
            for x in range(patches.column[v], patches.column[v] + patches.groups[v] * LANES):
                if patches.weights[k] > 0 and top <= y < bottom and left <= x < right:
                    row[n], column[n], value[n] = (y - top) * (right - left) + x - left, i, patches.weights[k]
                    n += 1
                k += 1
    return n


def _blur(taps: FloatImage, box: CameraBox, wide: CameraBox) -> sp.csr_matrix[np.float64]:
    """(pixels of ``box``, pixels of ``wide``): the camera's blur, as in ``blur_planes``."""
    down = _taps_between(taps, (box.top, box.bottom), (wide.top, wide.bottom))
    across = _taps_between(taps, (box.left, box.right), (wide.left, wide.right))
    return sp.csr_matrix(sp.kron(sp.csr_matrix(down), sp.csr_matrix(across), format="csr"))


def _taps_between(taps: FloatImage, to: tuple[int, int], since: tuple[int, int]) -> Float64:
    k = np.arange(*since)[None, :] - np.arange(*to)[:, None] + taps.size // 2
    return np.where((k >= 0) & (k < taps.size), taps[np.clip(k, 0, taps.size - 1)], 0).astype(np.float64)


SHARPENING_ROUNDS = 4
LEAST_VARIANCE_PX2 = 0.1
"""A metapixel is never thought sharper than this: a projector pixel has a size of its own."""


def gaussian_taps(sigma_px: tuple[float, float, float]) -> FloatImage:
    """(3, 2 r + 1) float32: a sampled Gaussian a channel, each summing to 1; a single 1 where there is no blur."""
    radius = max(0, math.ceil(3 * max(sigma_px)))
    at = np.arange(-radius, radius + 1)
    taps = np.stack([np.exp(-0.5 * (at / max(sigma, 1e-3)) ** 2) for sigma in sigma_px])
    return np.asarray(taps / taps.sum(axis=1, keepdims=True), np.float32)


@compiled(parallel=True, fastmath=True)
def blur_planes(planes: FloatImage, taps: FloatImage, scratch: FloatImage, out: FloatImage) -> None:
    """Convolve (3, rows, columns) with ``taps`` along both axes, nothing beyond the border; its own transpose.

    ``scratch`` and ``out`` have the shape of ``planes``; ``out`` may be ``planes``.
    """
    channels, rows, columns = planes.shape
    radius = taps.shape[1] // 2
    for line in prange(channels * rows):
        c, y = line // rows, line % rows
        row = scratch[c, y]
        row[:] = 0
        for k in range(taps.shape[1]):
            shift, tap = k - radius, taps[c, k]
            first, last = max(0, -shift), min(columns, columns - shift)
            for x in range(first, last):
                row[x] += tap * planes[c, y, x + shift]
    for line in prange(channels * rows):
        c, y = line // rows, line % rows
        row = out[c, y]
        row[:] = 0
        for k in range(max(0, radius - y), min(taps.shape[1], rows - y + radius)):
            tap, from_row = taps[c, k], scratch[c, y + k - radius]
            for x in range(columns):
                row[x] += tap * from_row[x]


def sharpened(image: FloatImage, taps: FloatImage) -> FloatImage:
    """What (3, rows, columns) >= 0 was before the blur, as far as noise allows: a few rounds of Richardson and Lucy."""
    found = image.copy()
    scratch, blurred = np.empty_like(image), np.empty_like(image)
    faint = 1e-6 * float(image.max(initial=0)) + 1e-30
    for _ in range(SHARPENING_ROUNDS):
        blur_planes(found, taps, scratch, blurred)
        np.divide(image, np.maximum(blurred, faint), out=blurred)
        blur_planes(blurred, taps, scratch, blurred)
        found *= blurred
    return found


def without_blur(metapixels: Metapixels, sigma_px: tuple[float, float, float]) -> Metapixels:
    """The metapixels on the object: their covariances minus the camera's, averaged over its channels."""
    variance = float(np.mean(np.square(sigma_px)))
    if variance == 0:
        return metapixels
    xx, xy, yy = np.moveaxis(metapixels.covariance_px2.astype(np.float64), -1, 0)
    middle, apart = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    least = np.minimum(LEAST_VARIANCE_PX2, middle - apart)
    wide, narrow = (np.maximum(value - variance, least) for value in (middle + apart, middle - apart))
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine, sine = np.where(apart > 0, (xx - yy) / 2 / apart, 1.0), np.where(apart > 0, xy / apart, 0.0)
    middle, apart = (wide + narrow) / 2, (wide - narrow) / 2
    covariance = np.stack([middle + apart * cosine, apart * sine, middle - apart * cosine], axis=-1)
    return dataclasses.replace(metapixels, covariance_px2=covariance.astype(np.float32))


@dataclass(frozen=True, eq=False, repr=False)
class PatchTransport(LightTransport):
    """T by metapixels.

    ``patches``: Gaussian weights of every metapixel, before normalisation
    ``gain`` (projectors, 3, rows, columns) float32: white over sum of weights, 0 where a camera pixel is not counted
    ``after`` (projectors, 3, rows, columns) float32: factor after the camera's blur; without blur (projectors, 3, 0, 0)
    ``taps`` (3, 2 r + 1) float32: the camera's blur along an axis; a single 1 where it is not modelled
    """

    patches: Patches
    gain: FloatImage
    after: FloatImage
    taps: FloatImage

    @classmethod
    def from_calibration(cls, calibration: Calibration, patches: Patches | None = None) -> PatchTransport:
        """Build T from metapixels, or from ``patches`` of another model; the calibration is consistent."""
        projectors = calibration.projectors
        shape = calibration.object_mask.shape
        blur_px = calibration.camera_blur_px
        on_object = tuple(without_blur(p.metapixels, blur_px) for p in projectors)
        if patches is None:
            patches = build_patches(on_object, (shape[0], shape[1]))
        taps = gaussian_taps(blur_px)
        blurred = taps.shape[1] > 1
        gain = np.ones((len(projectors), 3, *shape), np.float32)
        after = np.zeros((len(projectors), 3, *(shape if blurred else (0, 0))), np.float32)
        lit = np.zeros((len(projectors), *shape), np.bool_)
        ones = np.ones((3, patches.first.size), np.float32)
        plain = np.broadcast_to(np.eye(3, dtype=np.float32), (len(projectors), 3, 3)).copy()
        total = np.empty((3, *shape), np.float32)
        for n, projector in enumerate(projectors):
            forward_planes(patches, gain, plain, ones, (n, n + 1), total)
            white = projector.white
            bright = channels.largest(white) > FAINTEST * white.max(initial=0)
            lit[n] = calibration.object_mask & (total[0] > 0) & bright
            inverse = np.divide(1, total[0], out=np.zeros(shape, np.float32), where=lit[n])
            planes = image_planes(white)
            colour = sharpened(planes, taps) if blurred else planes
            np.multiply(colour, inverse, out=gain[n])
            if blurred:
                _match_white(planes, np.where(lit[n], colour, 0), taps, lit[n], after[n])
        total[:] = 1
        weights = np.zeros_like(ones)
        gaussian_sums(patches, lit, total, ones[0], (0, len(projectors)), weights)
        per_weight = np.divide(1, weights[0], out=np.zeros_like(weights[0]), where=weights[0] > 0)
        mixing = np.stack([p.radiometry.mixing for p in projectors]).astype(np.float32)
        sizes = tuple((p.metapixels.valid.shape[0], p.metapixels.valid.shape[1]) for p in projectors)
        return cls(mixing, lit, per_weight, sizes, patches, gain, after, taps)

    @property
    def _blurred(self) -> bool:
        return int(self.taps.shape[1]) > 1

    def forward_planes(
        self, p: FloatImage, *, projectors: tuple[int, int] | None = None, out: FloatImage | None = None
    ) -> FloatImage:
        """T p on planes: (3, pixels) to (3, rows, columns), for a range of projectors or for all."""
        out = np.empty((3, *self.camera_shape), np.float32) if out is None else out
        projectors = projectors or (0, len(self.sizes))
        if not self._blurred:
            forward_planes(self.patches, self.gain, self.mixing, p, projectors, out)
            return out
        out[:] = 0
        light, scratch = np.empty_like(out), np.empty_like(out)
        for n in range(*projectors):
            forward_planes(self.patches, self.gain, self.mixing, p, (n, n + 1), light)
            blur_planes(light, self.taps, scratch, light)
            multiply_add(out, self.after[n], light)
        return out

    def adjoint_planes(
        self, r: FloatImage, *, projectors: tuple[int, int] | None = None, out: FloatImage | None = None
    ) -> FloatImage:
        """T' r on planes, as ``LightTransport.adjoint_planes``."""
        out = np.zeros((3, self.pixels), np.float32) if out is None else out
        projectors = projectors or (0, len(self.sizes))
        if not self._blurred:
            adjoint_planes(self.patches, self.gain, self.mixing, r, projectors, out)
            return out
        for n in range(*projectors):
            light, scratch = self.after[n] * r, np.empty_like(r)
            blur_planes(light, self.taps, scratch, light)
            adjoint_planes(self.patches, self.gain, self.mixing, light, (n, n + 1), out)
        return out

    def gaussian_mean_planes(self, image: FloatImage, *, projectors: tuple[int, int] | None = None) -> FloatImage:
        """``gaussian_mean`` on planes: (3, rows, columns) to (3, pixels); pixels of other projectors are 0."""
        out = np.zeros((3, self.pixels), np.float32)
        gaussian_sums(self.patches, self.lit, image, self.per_weight, projectors or (0, len(self.sizes)), out)
        return out

    def submatrix(
        self, box: CameraBox, pixels: npt.NDArray[np.int64], channels: tuple[int, ...]
    ) -> sp.csr_matrix[np.float64]:
        """A part of T as a sparse matrix, as ``LightTransport.submatrix``."""
        radius = self.taps.shape[1] // 2
        wide = box.grown(radius, (int(self.patches.camera_shape[0]), int(self.patches.camera_shape[1])))
        owner = np.searchsorted(self.patches.start, pixels, side="right") - 1
        shares = _shares(self.patches, pixels, wide)
        by_projector = [np.flatnonzero(owner == n) for n in np.unique(owner)]
        order = np.argsort(np.concatenate(by_projector), kind="stable")
        blocks = []
        for c in channels:
            parts = []
            for mine in by_projector:
                n = int(owner[mine[0]])
                part = sp.diags_array(self.gain[n, c][wide.window].ravel().astype(np.float64)) @ shares[:, mine]
                if radius > 0:
                    factor = self.after[n, c][box.window].ravel().astype(np.float64)
                    part = sp.diags_array(factor) @ (_blur(self.taps[c], box, wide) @ part)
                parts.append(part)
            whole = sp.hstack(parts, format="csc")[:, order]
            mixed = [whole @ sp.diags_array(self.mixing[owner, c, d].astype(np.float64)) for d in channels]
            blocks.append(sp.hstack(mixed, format="csr"))
        return sp.csr_matrix(sp.vstack(blocks, format="csr"))

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """All that the products depend on, by name."""
        own = ("mixing", "lit", "per_weight", "gain", "after", "taps")
        return self.patches._asdict() | {name: getattr(self, name) for name in own}


def _match_white(white: FloatImage, colour: FloatImage, taps: FloatImage, lit: Mask, after: FloatImage) -> None:
    """Write the factor that makes the blurred ``colour`` (3, rows, columns) the ``white`` image again, where lit."""
    scratch, blurred = np.empty_like(white), np.empty_like(white)
    blur_planes(colour, taps, scratch, blurred)
    np.divide(white, blurred, out=after, where=lit & (blurred > 0))
