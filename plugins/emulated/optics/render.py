"""From projector frames to linear light in the camera: a look-up per cast sample, no rays.

Each projector pixel is a square with a fill factor, blurred by a Gaussian that is narrow in focus and wider away from
the focal surface. Both separate into x and y, so a pixel's light at a point is a product of two differences of erf.
"""

from __future__ import annotations

import functools
import hashlib
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from typing import Final, Protocol, TypeAlias

import cv2
import numba
import numpy as np
import numpy.typing as npt
from scipy.special import erf

from hal.runtime.jit import compiled
from plugins.emulated.optics.flaws import veiled
from plugins.emulated.optics.rays import BEYOND_PX, SIGMA_STEP_PX, Samples
from plugins.emulated.optics.truth import BenchTruth, LightTruth, ProjectorTruth

FloatImage: TypeAlias = npt.NDArray[np.float32]
ByteImage: TypeAlias = npt.NDArray[np.uint8]

SUBPIXELS: Final = 128
REACH_SIGMAS: Final = 3.2
LARGEST_RADIUS: Final = 13
MARGIN_PX: Final = LARGEST_RADIUS + int(BEYOND_PX) + 1
LAYERS_KEPT: Final = 3
LAYERS_BYTES: Final = 1 << 30
"""Of all projectors; at least one layer of each is kept."""


def response(light: LightTruth) -> npt.NDArray[np.float64]:
    """Linear light (256, 3) of each device value before black level and mixing: 0 at 0, 1 at 255, rising.

    A power law u = v^gamma, bent into a mild S by u + s u (1 - u) (2 u - 1).
    """
    power = (np.arange(256) / 255.0)[:, None] ** np.asarray(light.gamma)
    return np.asarray(power + np.asarray(light.s_curve) * power * (1.0 - power) * (2.0 * power - 1.0))


def channels(light: LightTruth, frame: ByteImage) -> FloatImage:
    """Linear light (rows, columns, 3) of a frame's red, green and blue before mixing."""
    table = light.black_level + (1.0 - light.black_level) * response(light)
    each = np.stack([table[:, c].astype(np.float32)[frame[..., c]] for c in range(3)], axis=-1)
    if light.white_segment > 0.0:
        each += np.float32(light.white_segment) * each.min(axis=-1, keepdims=True)
    return each


def emitted(light: LightTruth, frame: ByteImage) -> FloatImage:
    """Linear light (rows, columns, 3) in the camera's channels that a frame's pixels send out; white is about 1."""
    return veiled(channels(light, frame) @ np.asarray(light.mixing, dtype=np.float32).T, light.glare)


def sent_by_panels(
    projector: ProjectorTruth, frame: ByteImage, at_px: FloatImage
) -> Iterator[tuple[FloatImage, FloatImage]]:
    """What is sent out, in parts that lie alike: each with where it lies at points whose pixels are ``at_px``."""
    light, panels = projector.light, projector.panels
    if panels.aligned:
        yield emitted(light, frame), at_px
        return
    each, mixing = channels(light, frame), np.asarray(light.mixing, dtype=np.float32)
    centre = np.asarray(projector.lens.centre_px)
    for c in range(3):
        at = (at_px - np.asarray(panels.shift_px[c]) - centre) / (1.0 + panels.magnified[c]) + centre
        yield veiled(each[..., c : c + 1] * mixing[:, c], light.glare), at.astype(np.float32)


@functools.lru_cache(maxsize=4)
def pixel_profiles(fill_factor: float) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int32]]:
    """Cross-sections of a blurred pixel: weights (256, SUBPIXELS, 2 * LARGEST_RADIUS + 1), and radius (256,).

    The first index is the blur in SIGMA_STEP_PX, the second the position between two half pixels. The weights of
    an evenly lit image sum to 1 on average over positions; between narrow pixels the gap shows.
    """
    side = np.sqrt(fill_factor)
    sigma = np.maximum(np.arange(256), 1) * SIGMA_STEP_PX
    offset = (np.arange(SUBPIXELS) + 0.5) / SUBPIXELS - 0.5
    far = np.arange(-2 * LARGEST_RADIUS, 2 * LARGEST_RADIUS + 1)
    distance = offset[None, :, None] - far[None, None, :]
    scale = np.sqrt(2.0) * sigma[:, None, None]
    whole = (erf((distance + 0.5 * side) / scale) - erf((distance - 0.5 * side) / scale)) / (2.0 * side)
    radius = np.minimum(np.ceil(REACH_SIGMAS * sigma + 0.5 * side - 0.5), LARGEST_RADIUS).astype(np.int32)
    near = np.where(np.abs(far) <= radius[:, None, None], whole, 0.0)
    # What the cut takes from the tails goes back to the rest, so that an even image is not darker where blurred.
    near *= (whole.sum(axis=2) / np.maximum(near.sum(axis=2), 1e-30))[..., None]
    return np.ascontiguousarray(near[..., LARGEST_RADIUS:-LARGEST_RADIUS], dtype=np.float32), radius


class Returning(Protocol):
    """What engines for light between surfaces have in common."""

    def light(self, sent: Sequence[FloatImage | None]) -> FloatImage:
        """Irradiance (P, 3) at ``Samples.pixels`` for what the pixels (rows, columns, 3) of each projector send out."""


class Renderer:
    """Keeps the last layers of each projector, since most frames are shown more than once and by one projector."""

    def __init__(self, truth: BenchTruth, samples: Samples, transfer: Returning | None = None) -> None:
        self._truth = truth
        self._transfer = transfer
        self._samples = samples
        self._profiles = [pixel_profiles(p.light.fill_factor) for p in truth.projectors]
        self._layers: list[OrderedDict[bytes, FloatImage]] = [OrderedDict() for _ in truth.projectors]
        of_all = 12 * max(len(samples.pixels), 1) * len(truth.projectors)
        self._layers_kept = max(1, min(LAYERS_KEPT, LAYERS_BYTES // of_all))
        self._vignette = _vignette(truth)
        self._albedo = _pixel_sums(samples.albedo, samples.starts)
        self._ambient = self._albedo * np.asarray(truth.ambient, dtype=np.float32)
        self._last: tuple[tuple[object, ...], FloatImage] | None = None

    def light(self, frames: Sequence[ByteImage], levels: Sequence[float]) -> FloatImage:
        """Linear light (camera rows, columns, 3) float32; do not write to it.

        ``frames``: (rows, columns, 3) uint8 for each projector; ``levels``: its lamp's light, 0 dark to 1 full
        """
        digests = [hashlib.blake2b(np.ascontiguousarray(frame).data, digest_size=16).digest() for frame in frames]
        key = (*digests, *levels)
        if self._last is not None and self._last[0] == key:
            return self._last[1]
        total = self._ambient.copy()
        for index, (frame, level) in enumerate(zip(frames, levels, strict=True)):
            if level > 0.0:
                total += np.float32(level) * self._layer(index, frame, digests[index])
        if self._transfer is not None:
            total += self._albedo * self._returned(self._transfer, frames, levels)
        if self._truth.indirect > 0.0:
            # The mean light on what the camera sees stands for what object and room throw back.
            lit = (total - self._ambient).sum(axis=0, dtype=np.float64) / np.maximum(self._albedo.sum(axis=0), 1e-9)
            total += self._albedo * (self._truth.indirect * lit).astype(np.float32)
        image = self._through_lens(total)
        self._last = (key, image)
        return image

    def _returned(self, transfer: Returning, frames: Sequence[ByteImage], levels: Sequence[float]) -> FloatImage:
        """Irradiance (P, 3) that object and surfaces throw back."""
        sent = [
            np.float32(level) * emitted(projector.light, frame) if level > 0.0 else None
            for projector, frame, level in zip(self._truth.projectors, frames, levels, strict=True)
        ]
        return transfer.light(sent)

    def _layer(self, index: int, frame: ByteImage, digest: bytes) -> FloatImage:
        """One projector's light (P, 3) at full lamp, summed over each camera pixel's samples."""
        kept = self._layers[index]
        if digest in kept:
            kept.move_to_end(digest)
            return kept[digest]
        samples, (profiles, radii) = self._samples, self._profiles[index]
        gloss = samples.gloss[index]
        albedo = samples.albedo + gloss[:, None] if gloss.size else samples.albedo
        layer: FloatImage | None = None
        for sent, at_px in sent_by_panels(self._truth.projectors[index], frame, samples.at_px[index]):
            padded = cv2.copyMakeBorder(sent, *(MARGIN_PX,) * 4, cv2.BORDER_CONSTANT, value=0)
            part = _lit_pixels(
                np.ascontiguousarray(padded), at_px, samples.gain[index], samples.blur[index],
                albedo, samples.starts, profiles, radii,
            )  # fmt: skip
            layer = part if layer is None else layer + part
        assert layer is not None
        kept[digest] = layer
        if len(kept) > self._layers_kept:
            kept.popitem(last=False)
        return layer

    def _through_lens(self, total: FloatImage) -> FloatImage:
        width, height = self._truth.camera.lens.size_px
        flat = np.zeros((height * width, 3), dtype=np.float32)
        flat[self._samples.pixels] = total
        image: FloatImage = flat.reshape(height, width, 3)
        sigma = self._truth.camera.psf_sigma_px
        if sigma > 0.05:
            image = np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), dtype=np.float32)
        image = veiled(image, self._truth.camera.glare)
        image *= self._vignette[..., None]
        image.flags.writeable = False
        return image


def _vignette(truth: BenchTruth) -> FloatImage:
    """(rows, columns): 1 in the middle, falling with the fourth power of the cosine-like radius to the corners."""
    width, height = truth.camera.lens.size_px
    x = (np.arange(width) - 0.5 * (width - 1)) / (0.5 * width)
    y = (np.arange(height) - 0.5 * (height - 1)) / (0.5 * height)
    square = (x[None, :] ** 2 * width**2 + y[:, None] ** 2 * height**2) / (width**2 + height**2)
    loss = truth.camera.vignetting
    return (1.0 - loss * square * (1.6 - 0.6 * square)).astype(np.float32)


@compiled(parallel=True, fastmath=True)
def _lit_pixels(
    frame: FloatImage,
    at_px: FloatImage,
    gain: FloatImage,
    blur: npt.NDArray[np.uint8],
    albedo: FloatImage,
    starts: npt.NDArray[np.int32],
    profiles: FloatImage,
    radii: npt.NDArray[np.int32],
) -> FloatImage:
    """Light (P, 3) of each camera pixel: the sum over its samples of albedo x gain x the blurred frame."""
    pixels = len(starts) - 1
    out = np.zeros((pixels, 3), dtype=np.float32)
    for pixel in numba.prange(pixels):
        for n in range(starts[pixel], starts[pixel + 1]):
            if gain[n] <= 0.0:
                continue
            column, row = int(np.floor(at_px[n, 0] + 0.5)), int(np.floor(at_px[n, 1] + 0.5))
            across = profiles[blur[n], min(int((at_px[n, 0] - column + 0.5) * SUBPIXELS), SUBPIXELS - 1)]
            down = profiles[blur[n], min(int((at_px[n, 1] - row + 0.5) * SUBPIXELS), SUBPIXELS - 1)]
            radius = radii[blur[n]]
            red = green = blue = np.float32(0.0)
            for j in range(-radius, radius + 1):
                r = g = b = np.float32(0.0)
                for i in range(-radius, radius + 1):
                    weight = across[LARGEST_RADIUS + i]
                    r += weight * frame[row + j + MARGIN_PX, column + i + MARGIN_PX, 0]
                    g += weight * frame[row + j + MARGIN_PX, column + i + MARGIN_PX, 1]
                    b += weight * frame[row + j + MARGIN_PX, column + i + MARGIN_PX, 2]
                red += down[LARGEST_RADIUS + j] * r
                green += down[LARGEST_RADIUS + j] * g
                blue += down[LARGEST_RADIUS + j] * b
            out[pixel, 0] += gain[n] * albedo[n, 0] * red
            out[pixel, 1] += gain[n] * albedo[n, 1] * green
            out[pixel, 2] += gain[n] * albedo[n, 2] * blue
    return out


@compiled()
def _pixel_sums(values: FloatImage, starts: npt.NDArray[np.int32]) -> FloatImage:
    """Sums (P, 3) of the samples (N, 3) of each pixel."""
    out = np.zeros((len(starts) - 1, 3), dtype=np.float32)
    for pixel in range(len(starts) - 1):
        for n in range(starts[pixel], starts[pixel + 1]):
            for c in range(3):
                out[pixel, c] += values[n, c]
    return out
