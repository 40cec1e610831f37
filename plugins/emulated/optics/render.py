"""From projector frames to linear light in the camera: sums over cast samples, no rays."""

from __future__ import annotations

import functools
import hashlib
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from typing import Final, Protocol, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from hal.runtime.jit import compiled
from plugins.emulated.optics.flaws import veiled
from plugins.emulated.optics.footprints import KEPT_BYTES, Footprints, Lit
from plugins.emulated.optics.rays import Samples
from plugins.emulated.optics.truth import BenchTruth, LightTruth, ProjectorTruth

FloatImage: TypeAlias = npt.NDArray[np.float32]
ByteImage: TypeAlias = npt.NDArray[np.uint8]

LAYERS_KEPT: Final = 3
LAYERS_BYTES: Final = 1 << 30
"""Of all projectors; at least one layer of each is kept."""
SHADOW_EDGE: Final = 0.04
"""Width of a shadow's soft edge, in picture widths: who stands near the lens is far out of its focus."""


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
    if light.shadow > 0.0:
        across = (np.arange(frame.shape[1], dtype=np.float32) + 0.5) / frame.shape[1]
        each *= np.clip((across - light.shadow) / SHADOW_EDGE + 0.5, 0.0, 1.0)[:, None].astype(np.float32)
    return each


def emitted(light: LightTruth, frame: ByteImage) -> FloatImage:
    """Linear light (rows, columns, 3) in the camera's channels that a frame's pixels send out; white is about 1."""
    return veiled(channels(light, frame) @ np.asarray(light.mixing, dtype=np.float32).T, light.glare)


def sent_by_panels(projector: ProjectorTruth, frame: ByteImage) -> Iterator[FloatImage]:
    """Linear light (rows, columns, 3) that is sent out, in parts that lie alike: one for each of ``panel_places``."""
    light = projector.light
    if projector.panels.aligned:
        yield emitted(light, frame)
        return
    each, mixing = channels(light, frame), np.asarray(light.mixing, dtype=np.float32)
    for c in range(3):
        yield veiled(each[..., c : c + 1] * mixing[:, c], light.glare)


def panel_places(projector: ProjectorTruth, at_px: FloatImage) -> list[FloatImage]:
    """Where each part of ``sent_by_panels`` lies at points whose projector pixels are ``at_px`` (N, 2)."""
    panels, centre = projector.panels, np.asarray(projector.lens.centre_px)
    if panels.aligned:
        return [at_px]
    return [
        ((at_px - np.asarray(shift) - centre) / (1.0 + magnified) + centre).astype(np.float32)
        for shift, magnified in zip(panels.shift_px, panels.magnified, strict=True)
    ]


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
        self._footprints: list[list[Footprints] | None] = [None] * len(truth.projectors)
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
        sent = sent_by_panels(self._truth.projectors[index], frame)
        parts = [lit.light(one) for lit, one in zip(self._footprints_of(index), sent, strict=True)]
        layer = functools.reduce(np.add, parts)
        kept[digest] = layer
        if len(kept) > self._layers_kept:
            kept.popitem(last=False)
        return layer

    def _footprints_of(self, index: int) -> list[Footprints]:
        """Of each part of ``sent_by_panels``; made when the projector shows its first frame."""
        made = self._footprints[index]
        if made is None:
            samples, projector, gloss = self._samples, self._truth.projectors[index], self._samples.gloss[index]
            albedo = samples.albedo + gloss[:, None] if gloss.size else samples.albedo
            places = panel_places(projector, samples.at_px[index])
            made = self._footprints[index] = [
                Footprints.of(
                    Lit(samples.starts, at_px, samples.gain[index], samples.blur[index], albedo),
                    projector.light.fill_factor,
                    most_bytes=KEPT_BYTES // len(places),
                )
                for at_px in places
            ]
        return made

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


@compiled()
def _pixel_sums(values: FloatImage, starts: npt.NDArray[np.int32]) -> FloatImage:
    """Sums (P, 3) of the samples (N, 3) of each pixel."""
    out = np.zeros((len(starts) - 1, 3), dtype=np.float32)
    for pixel in range(len(starts) - 1):
        for n in range(starts[pixel], starts[pixel + 1]):
            for c in range(3):
                out[pixel, c] += values[n, c]
    return out
