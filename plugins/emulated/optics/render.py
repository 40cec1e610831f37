"""From projector frames to linear light in the camera: sums over cast samples, no rays."""

from __future__ import annotations

import functools
import hashlib
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from hal.runtime.jit import compiled
from plugins.emulated.core.truth import BenchTruth, Dithering, LightTruth, ProjectorTruth
from plugins.emulated.optics.effects import rare, veiled
from plugins.emulated.optics.footprints import KEPT_BYTES, Footprints, LitSamples
from plugins.emulated.optics.rays import Samples
from plugins.emulated.optics.sensor import SENSOR_WIDTH_MM

FloatImage: TypeAlias = npt.NDArray[np.float32]
ByteImage: TypeAlias = npt.NDArray[np.uint8]

FOCUS: Final = "The depth of field of bench.toml"
LAYERS_KEPT: Final = 3
LAYERS_BYTES: Final = 1 << 30
"""Of all projectors; at least one layer of each is kept."""
SHADOW_EDGE: Final = 0.04
"""Width of a shadow's soft edge, in picture widths: who stands near the lens is far out of its focus."""
DENT: Final = (0.55, 0.06)
"""Middle and width of a dent, as shares of the device values."""


@dataclass(frozen=True, slots=True)
class Shutter:
    """How long a picture is exposed, from which moment on, and through which aperture."""

    start_s: float = 0.0
    open_s: float = 1.0
    aperture_f: float = 8.0


ALWAYS: Final = Shutter()


def response(light: LightTruth) -> npt.NDArray[np.float64]:
    """Linear light (256, 3) of each device value before black level and mixing: 0 at 0, 1 at 255, rising.

    A power law u = v^gamma, bent into a mild S by u + s u (1 - u) (2 u - 1), less a dent.
    """
    values = (np.arange(256) / 255.0)[:, None]
    power = values ** np.asarray(light.gamma)
    bent = power + np.asarray(light.s_curve) * power * (1.0 - power) * (2.0 * power - 1.0)
    return np.asarray(bent * (1.0 - light.dent * np.exp(-(((values - DENT[0]) / DENT[1]) ** 2))))


def channels(
    light: LightTruth, frame: ByteImage, dithering: Dithering | None = None, shutter: Shutter = ALWAYS
) -> FloatImage:
    """Linear light (rows, columns, 3) of a frame's red, green and blue before mixing, as ``shutter`` sees it."""
    black, table = light.black_level, response(light)
    if dithering is None or dithering.levels < 2:
        table = black + (1.0 - black) * table
        each = _looked_up(table, frame)
    else:
        start, frames = shutter.start_s / dithering.frame_s, shutter.open_s / dithering.frame_s
        exact = _looked_up(table, frame)
        mean_light = rare("The dithered panel of bench.toml").mean_light
        made = mean_light(exact, levels=dithering.levels, turns=dithering.turns, start=start, frames=frames)
        each = np.float32(black) + np.float32(1.0 - black) * made
    if light.white_segment > 0.0:
        each += np.float32(light.white_segment) * each.min(axis=-1, keepdims=True)
    if light.shadow > 0.0:
        across = (np.arange(frame.shape[1], dtype=np.float32) + 0.5) / frame.shape[1]
        each *= np.clip((across - light.shadow) / SHADOW_EDGE + 0.5, 0.0, 1.0)[:, None].astype(np.float32)
    return each


def _looked_up(table: npt.NDArray[np.float64], frame: ByteImage) -> FloatImage:
    return np.stack([table[:, c].astype(np.float32)[frame[..., c]] for c in range(3)], axis=-1)


def emitted(light: LightTruth, frame: ByteImage) -> FloatImage:
    """Linear light (rows, columns, 3) in the camera's channels that a frame's pixels send out; white is about 1."""
    return veiled(channels(light, frame) @ np.asarray(light.mixing, dtype=np.float32).T, light.glare)


def sent_by_panels(projector: ProjectorTruth, each: FloatImage, mixing: FloatImage) -> Iterator[FloatImage]:
    """Linear light (rows, columns, 3) that is sent out, in parts that lie alike: one for each of ``panel_places``.

    ``each``: the light of its ``channels``; ``mixing`` (3, 3): of them into three colours
    """
    glare = projector.light.glare
    if projector.panels.aligned:
        yield veiled(each @ mixing.T, glare)
        return
    for c in range(3):
        yield veiled(each[..., c : c + 1] * mixing[:, c], glare)


def panel_places(projector: ProjectorTruth, at_px: FloatImage) -> list[FloatImage]:
    """Where each part of ``sent_by_panels`` lies at points whose projector pixels are ``at_px`` (N, 2)."""
    panels, centre = projector.panels, np.asarray(projector.lens.centre_px)
    if panels.aligned:
        return [at_px]
    return [
        ((at_px - np.asarray(shift) - centre) / (1.0 + magnified) + centre).astype(np.float32)
        for shift, magnified in zip(panels.shift_px, panels.magnified, strict=True)
    ]


class IndirectLight(Protocol):
    """What engines for light between surfaces have in common."""

    def light(self, sent: Sequence[FloatImage | None]) -> FloatImage:
        """Irradiance (P, 3) at ``Samples.pixels`` for what the pixels (rows, columns, 3) of each projector send out."""


class Renderer:
    """Keeps the last layers of each projector, since most frames are shown more than once and by one projector."""

    def __init__(self, truth: BenchTruth, samples: Samples, transfer: IndirectLight | None = None) -> None:
        self._truth = truth
        self._transfer = transfer
        self._samples = samples
        self._footprints: list[tuple[list[Footprints], list[Footprints]] | None] = [None] * len(truth.projectors)
        self._layers: list[OrderedDict[bytes, FloatImage]] = [OrderedDict() for _ in truth.projectors]
        of_all = 12 * max(len(samples.pixels), 1) * len(truth.projectors)
        self._layers_kept = max(1, min(LAYERS_KEPT, LAYERS_BYTES // of_all))
        self._vignette = np.repeat(_vignette(truth)[..., None], 3, axis=2)
        self._sees_everywhere = np.array_equal(samples.pixels, np.arange(self._vignette[..., 0].size))
        self._albedo = _pixel_sums(samples.albedo, samples.starts)
        self._ambient = self._albedo * np.asarray(truth.ambient, dtype=np.float32)
        self._tensors = [_colours(truth, projector) for projector in truth.projectors]
        self._on_white = [
            np.asarray(one.light.mixing if tensor is None else tensor.sum(axis=1), np.float32)
            for one, tensor in zip(truth.projectors, self._tensors, strict=True)
        ]
        self._paint = _seen_paint(self._albedo, self._tensors)
        spread = truth.object.subsurface
        self._surface: Any = None
        if spread.share > 0.0:
            # Of the object alone: what spreads under its surface does not come out of the table that it stands on.
            width, on = truth.camera.lens.size_px[0], samples.on_object
            kind = rare("Light under the surface, as bench.toml has it,").Spread
            self._surface = kind.over(samples.pixels[on], samples.points[on], width, spread.spread_m)
        self._last: tuple[tuple[object, ...], FloatImage] | None = None

    def light(self, frames: Sequence[ByteImage], levels: Sequence[float], shutter: Shutter = ALWAYS) -> FloatImage:
        """Linear light (camera rows, columns, 3) float32; do not write to it.

        ``frames``: (rows, columns, 3) uint8 for each projector; ``levels``: its lamp's light, 0 dark to 1 full
        """
        digests = [_digest(frame) for frame in frames]
        key = (*digests, *levels, *self._seen_of(shutter))
        if self._last is not None and self._last[0] == key:
            return self._last[1]
        total = self._ambient.copy()
        for index, (frame, level) in enumerate(zip(frames, levels, strict=True)):
            if level > 0.0:
                total += np.float32(level) * self._layer(index, frame, shutter)
        if self._truth.indirect > 0.0:
            # The mean light on what the camera sees stands for what object and room throw back.
            lit = (total - self._ambient).sum(axis=0, dtype=np.float64) / np.maximum(self._albedo.sum(axis=0), 1e-9)
            total += self._albedo * (self._truth.indirect * lit).astype(np.float32)
        image = self._through_lens(total, shutter.aperture_f)
        self._last = (key, image)
        return image

    def _seen_of(self, shutter: Shutter) -> tuple[object, ...]:
        """What of a shutter makes pictures differ on this stage."""
        dithered = any(projector.dithering.levels > 1 for projector in self._truth.projectors)
        return (shutter,) if dithered or self._truth.camera.focus_m > 0.0 else ()

    def _returned(self, transfer: IndirectLight, index: int, each: FloatImage) -> FloatImage:
        """Light (P, 3) of a frame's channels that object and surfaces throw back."""
        sent: list[FloatImage | None] = [None] * len(self._truth.projectors)
        sent[index] = veiled(each @ self._on_white[index].T, self._truth.projectors[index].light.glare)
        returned = transfer.light(sent)
        return np.multiply(self._paint, returned, out=returned)

    def _layer(self, index: int, frame: ByteImage, shutter: Shutter) -> FloatImage:
        """One projector's light (P, 3) at full lamp, summed over each camera pixel's samples, with what comes back of
        it from object and surfaces.
        """
        projector, kept = self._truth.projectors[index], self._layers[index]
        # Of a dithered frame, turns may differ. Those of black do not.
        each = channels(projector.light, frame, projector.dithering, shutter)
        if (digest := _digest(each)) in kept:
            kept.move_to_end(digest)
            return kept[digest]
        paint, gloss = self._footprints_of(index)
        layer = self._spread(self._through(index, paint, each))
        if gloss:
            layer = layer + self._through(index, gloss, each)
        if self._transfer is not None:
            layer = np.add(layer, returned := self._returned(self._transfer, index, each), out=returned)
        kept[digest] = layer
        if len(kept) > self._layers_kept:
            kept.popitem(last=False)
        return layer

    def _through(self, index: int, footprints: Sequence[Footprints], each: FloatImage) -> FloatImage:
        """Light (P, 3) of a frame's channels by the footprints of each of its ``panel_places``."""
        projector, tensor = self._truth.projectors[index], self._tensors[index]
        if tensor is None:
            parts = sent_by_panels(projector, each, self._on_white[index])
            return functools.reduce(np.add, (lit.light(one) for lit, one in zip(footprints, parts, strict=True)))
        # What the camera sees of a channel is a sum over the paint's three albedos.
        seen = []
        for channel in range(3):
            alone = veiled(np.repeat(each[..., channel, None], 3, axis=2), projector.light.glare)
            by_albedo = footprints[0 if projector.panels.aligned else channel].light(alone)
            seen.append(by_albedo @ tensor[:, :, channel].T)
        return functools.reduce(np.add, seen)

    def _spread(self, layer: FloatImage) -> FloatImage:
        """The light of a layer, part of which leaves the surface elsewhere."""
        share = np.float32(self._truth.object.subsurface.share)
        if self._surface is None:
            return layer
        on = self._samples.on_object
        seen, paint = layer[on], self._paint[on]
        falling = np.divide(seen, paint, out=np.zeros_like(seen), where=paint > 0.0)
        spread = layer.copy()
        spread[on] = (1 - share) * seen + share * paint * self._surface.of(falling)
        return spread

    def _footprints_of(self, index: int) -> tuple[list[Footprints], list[Footprints]]:
        """Of each part of ``sent_by_panels``, on paint and, where light spreads below, apart from it on the gloss.

        Made when the projector shows its first frame.
        """
        made = self._footprints[index]
        if made is None:
            samples, gloss = self._samples, self._samples.gloss[index]
            white = np.repeat(gloss[:, None], 3, axis=1)
            # One for both: they are as large as all samples.
            places = panel_places(self._truth.projectors[index], samples.at_px[index])
            if self._surface is None:
                paint = samples.albedo + white if gloss.size else samples.albedo
                made = self._summed(index, places, paint), []
            else:
                shine = self._summed(index, places, white) if gloss.size else []
                made = self._summed(index, places, samples.albedo), shine
            self._footprints[index] = made
        return made

    def _summed(self, index: int, places: Sequence[FloatImage], albedo: FloatImage) -> list[Footprints]:
        samples, projector = self._samples, self._truth.projectors[index]
        return [
            Footprints.of(
                LitSamples(samples.starts, at_px, samples.gain[index], samples.blur[index], albedo),
                projector.light.fill_factor,
                most_bytes=KEPT_BYTES // len(places),
            )
            for at_px in places
        ]

    def _through_lens(self, total: FloatImage, aperture_f: float) -> FloatImage:
        camera = self._truth.camera
        width, height = camera.lens.size_px
        flat = total
        if not self._sees_everywhere:
            flat = np.zeros((height * width, 3), dtype=np.float32)
            flat[self._samples.pixels] = total
        image: FloatImage = flat.reshape(height, width, 3)
        if camera.focus_m > 0.0:
            image = rare(FOCUS).defocused(image, self._confusion(aperture_f))
        sigma = camera.psf_sigma_px
        if sigma > 0.05:
            image = np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), dtype=np.float32)
        image = veiled(image, camera.glare)
        image *= self._vignette
        image.flags.writeable = False
        return image

    def _confusion(self, aperture_f: float) -> FloatImage:
        """(rows, columns): standard deviation of each pixel's circle of confusion, px."""
        camera = self._truth.camera
        (width, height), pose = camera.lens.size_px, camera.pose
        depth = (self._samples.points.astype(np.float64) - pose.position_m) @ pose.rotation[2]
        flat = np.zeros(height * width, np.float32)
        flat[self._samples.pixels] = rare(FOCUS).confusion_px(
            depth, focal_px=camera.lens.focal_px, pixel_m=1e-3 * SENSOR_WIDTH_MM / width,
            aperture_f=aperture_f, focus_m=camera.focus_m,
        )  # fmt: skip
        return flat.reshape(height, width)


def _digest(image: npt.NDArray[Any]) -> bytes:
    return hashlib.blake2b(np.ascontiguousarray(image).data, digest_size=16).digest()


def _colours(truth: BenchTruth, projector: ProjectorTruth) -> FloatImage | None:
    """(3 camera, 3 paint, 3 channels): see ``lab.emulated.spectra.colours``; None where light has no wavelengths."""
    light = projector.light
    if not truth.camera.spectral or not all(width > 0.0 for _, width in light.bands_nm):
        return None
    white = np.asarray(light.mixing).sum(axis=1)
    colours = rare("Light by wavelength, as bench.toml has it,").colours
    return np.asarray(colours(light.bands_nm, truth.camera.bands_nm, white), np.float32)


def _seen_paint(albedo: FloatImage, tensors: Sequence[FloatImage | None]) -> FloatImage:
    """(P, 3): the share of white light from all projectors that the camera sees of each pixel's paint."""
    by_camera = [np.eye(3) if one is None else one.sum(axis=2) / one.sum(axis=(1, 2))[:, None] for one in tensors]
    if all(one is None for one in tensors):
        return albedo
    return np.asarray(albedo @ np.mean(by_camera, axis=0).T, np.float32)


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
