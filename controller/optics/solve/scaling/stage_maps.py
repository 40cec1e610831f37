"""A stage's maps for base times scale (``bundle.live_maps``), made from its light transport and its solved base.

P_s is the mean of the scale image C_s over a projector pixel's light in the camera (paper eq. 6). The light transport
gives that mean exactly; here each pixel keeps the centre and the covariance of its weights, which are those of a
Gaussian to within what a stage's grade leaves open (docs/decisions/0010), and the mean is taken over a narrower one
(docs/decisions/0010).

The maps of indirect light for live targets (``bundle.live_maps``) are made from the stage's G. Live targets have
few, large blocks: indirect light is smooth but for the paint, which stays in the target's own pixels
(docs/decisions/0014).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from controller.bundle.live_maps import FULL, SAMPLES, TILE, LiveIndirect, LiveMaps, OutputMaps, packed_shape
from controller.core import channels
from controller.core.arrays import FloatImage
from controller.optics.calibrate.values import Radiometry
from controller.optics.capture.encoding import checked_response
from controller.optics.solve.appearance import Base, StageLight
from controller.optics.solve.scaling.dither import blue_noise
from controller.optics.transport import LightTransport
from controller.optics.transport.indirect.indirect_light import IndirectLight
from controller.optics.transport.planes import image_planes, plane_frames, plane_image

LARGEST_TARGET_PX: Final = 2048
"""A side of the targets; a larger camera picture is reduced by a whole number."""
WAVE_PX: Final = 64.0
"""Of the waves by which spreads are measured: long beside any projector pixel, short enough for single precision."""
LEAST_SIGMA_PX: Final = 0.3
MOST_CORRELATION: Final = 0.95
NARROWED: Final = 0.4
"""The mean is taken over this part of a projector pixel's spread: shown, the pixel blurs the scale a second time."""


def scaling_maps(
    light: StageLight,
    base: Base,
    radiometries: Sequence[Radiometry],
    names: Sequence[str] | None = None,
    *,
    largest_px: int = LARGEST_TARGET_PX,
    spread: float = NARROWED,
) -> LiveMaps:
    """The maps of a stage.

    One radiometry and one of ``names``, those of the outputs, a projector; targets' sides are at most ``largest_px``;
    means are taken over the part ``spread`` of a pixel's spread, 1 for those of the paper (eq. 6). Light
    by way of other surfaces is left out of what the projectors make; colours that depend on the paint are corrected.
    Raises UsageError("response-not-rising").
    """
    # those of several views have no maps
    indirect = light.indirect if isinstance(light.indirect, IndirectLight) else None
    transport, black = light.transport, light.black
    factor = reduction(transport.camera_shape, largest_px)
    lit = base.inverse > 0
    unit = float(np.median(1 / base.inverse[lit])) if lit.any() else 1.0
    present = np.asarray(np.rint(255 * reduced(lit.mean(axis=0, dtype=np.float32), factor)), np.uint8)
    outputs = _output_maps(transport, base, radiometries, names, (present.shape[1], present.shape[0]), factor, spread)
    inverse = plane_image(base.inverse)
    gain = reduced(inverse, factor, unit).astype(np.float16)
    dark = reduced(np.maximum(black, 0), factor) * gain.astype(np.float32) / np.float32(unit)
    offset = np.maximum(dark, reduced(plane_image(base.inverse * image_planes(np.maximum(black, 0))), factor))
    thrown = paint = None
    if indirect is not None:
        reduce = partial(reduced, factor=factor)
        paint = paint_map(indirect, inverse, reduce)
        if indirect.factors.any():
            reach = indirect.painted(transport.reach())
            thrown = indirect_maps(indirect, reach, black, inverse, unit, factor, reduce)
    size_px = present.shape[1], present.shape[0]
    return LiveMaps(size_px, gain, _rounded_up(offset), present, unit, blue_noise(), outputs, thrown, paint)


def _output_maps(
    transport: LightTransport,
    base: Base,
    radiometries: Sequence[Radiometry],
    names: Sequence[str] | None,
    target_px: tuple[int, int],
    factor: int,
    spread: float,
) -> tuple[OutputMaps, ...]:
    """Of each projector: its base frame, and from where in a target of ``target_px`` (width, height) a pixel takes."""
    centre, sigma, correlation = footprints(transport, factor)
    sides = np.maximum(np.array(target_px, np.float32) - 1, np.float32(1))
    places = np.asarray(np.rint(FULL * np.clip(centre / sides, 0, 1)), np.uint16)
    shapes = packed_shape(np.where(sigma > 0, np.maximum(np.float32(spread) * sigma, LEAST_SIGMA_PX), 0), correlation)
    mixed = plane_frames(base.mixed, transport.sizes)
    outputs = []
    for n, size in enumerate(transport.sizes):
        span, radiometry = transport.span(n), radiometries[n]
        low, high = float(mixed[n].min()), float(mixed[n].max())
        scaled = (mixed[n] - np.float32(low)) / np.float32(max(high - low, 1e-30))
        outputs.append(
            OutputMaps(
                str(n) if names is None else names[n],
                np.asarray(np.rint(FULL * scaled), np.uint16), (low, high),
                places[span].reshape(*size, 2), shapes[span].reshape(*size, 3),
                np.linalg.inv(transport.mixing[n].astype(np.float64)).astype(np.float32),
                checked_response(radiometry.response), (17 * n % TILE, 29 * n % TILE), radiometry.segment,
            )
        )  # fmt: skip
    return tuple(outputs)


def _rounded_up(values: FloatImage) -> npt.NDArray[np.float16]:
    """In half precision, rounded up: a target like the black image must give black, not speckles."""
    near = (values * np.float32(1 + 1e-6)).astype(np.float16)
    return np.where(near < values, np.nextafter(near, np.float16(np.inf)), near)


def reduction(camera: tuple[int, int], largest_px: int = LARGEST_TARGET_PX) -> int:
    """How many pixels of the camera (rows, columns) a target's pixel is wide."""
    return -(-max(camera) // largest_px)


def reduced(image: FloatImage, factor: int, times: float = 1.0) -> FloatImage:
    """Means of blocks of ``factor`` pixels; the edge is repeated, so that every target pixel is a whole block."""
    rows, columns = image.shape[:2]
    size = -(-columns // factor), -(-rows // factor)
    padded = np.pad(
        image,
        [(0, size[1] * factor - rows), (0, size[0] * factor - columns), *[(0, 0)] * (image.ndim - 2)],
        mode="edge",
    )
    small = padded if factor == 1 else cv2.resize(padded, size, interpolation=cv2.INTER_AREA)
    return np.asarray(small * np.float32(times), np.float32)


def footprints(transport: LightTransport, factor: int) -> tuple[FloatImage, FloatImage, FloatImage]:
    """Position of each projector pixel's weights in the target, reduced by ``factor``.

    Returns the means (pixels, 2) as (x, y), the standard deviations (pixels, 2), 0 where a pixel lights nothing, and
    the correlations (pixels,). Spreads are measured by how much a wave is dampened, which keeps single precision where
    the mean of squares would lose it.
    """
    rows, columns = transport.camera_shape
    y, x = np.mgrid[0:rows, 0:columns].astype(np.float32)
    mean = _Means(transport)
    centre = np.stack([mean(x), mean(y)], axis=-1)
    across, down, both = (_variance(mean, wave) for wave in (x, y, x + y))
    # The blur of the mean over a target's pixel.
    box = (factor**2 - 1) / 12
    variance = np.stack([across, down], axis=-1) - box
    sigma = np.sqrt(np.maximum(variance, (LEAST_SIGMA_PX * factor) ** 2)) / factor
    covariance = (both - across - down) / 2 / factor**2
    correlation = np.clip(covariance / (sigma[:, 0] * sigma[:, 1]), -MOST_CORRELATION, MOST_CORRELATION)
    sigma[~mean.lit] = 0
    place = (centre + np.float32(0.5)) / np.float32(factor) - np.float32(0.5)
    return place.astype(np.float32), sigma.astype(np.float32), np.asarray(correlation, np.float32)


class _Means:
    """Means of one-channel images over every projector pixel, of all channels together; 0 where ``lit`` is False."""

    def __init__(self, transport: LightTransport) -> None:
        self._transport = transport
        self._count = transport.gaussian_mean_planes(np.ones((3, *transport.camera_shape), np.float32)).sum(axis=0)
        self.lit = self._count > 0

    def __call__(self, image: FloatImage) -> FloatImage:
        planes = np.ascontiguousarray(np.broadcast_to(image, (3, *image.shape)), np.float32)
        total = self._transport.gaussian_mean_planes(planes).sum(axis=0)
        return np.asarray(np.divide(total, self._count, out=np.zeros_like(total), where=self.lit), np.float32)


def _variance(mean: _Means, along: FloatImage) -> FloatImage:
    turn = np.float32(2 * np.pi / WAVE_PX)
    power = mean(np.cos(turn * along)) ** 2 + mean(np.sin(turn * along)) ** 2
    logarithm: FloatImage = np.log(np.maximum(power, np.float32(1e-6)))
    return np.asarray(np.maximum(-logarithm / turn**2, 0), np.float32)


LIVE_BLOCKS: Final = 300
"""At most about so many in the whole picture: their products cost less than a tenth of a millisecond."""
GENERATOR: Final = 27
"""Of the lattice of samples in a block: even along both sides."""
MOST_CORRECTION: Final = 2.0
"""By which large blocks are made to throw back as much white as small ones."""
MOST_PAINT: Final = 8.0
"""Of another colour's scale that is added: paints that throw back nearly one colour would need more."""

Reduce = Callable[[FloatImage], FloatImage]


def indirect_maps(
    indirect: IndirectLight,
    reach: FloatImage,
    black: FloatImage,
    inverse: FloatImage,
    unit: float,
    factor: int,
    reduce: Reduce,
) -> LiveIndirect:
    """The live maps of ``indirect``.

    Parameters
    ----------
    reach, black : (rows, columns, 3) all direct light of the projectors as the paint shows it, and the black image
    inverse : (rows, columns, 3) 1 / base light, 0 where there is none
    unit : radiance by which ``LiveMaps.gain`` was multiplied
    factor : camera pixels along a target pixel; ``reduce``: from those of the camera to those of the target
    """
    merged = max(1, round(float(np.sqrt(len(indirect.factors) / LIVE_BLOCKS))))
    factors, grid = _merged(indirect.factors, indirect.grid, merged)
    most = reduce(np.where(indirect.lit[..., None], reach, 0).astype(np.float32))
    high, wide = most.shape[:2]
    side = float(np.float32(merged * indirect.side / factor))
    places, inside = _places(grid, side, (high, wide))
    empty = np.zeros((3, SAMPLES, len(factors), 3), np.float32)
    bare = LiveIndirect(factors, grid, side, places, empty, np.zeros((high, wide, 3), np.float16))
    direct = np.where(inside[..., None], bare.samples(most), 0).astype(np.float32)
    white = bare.spread((factors @ direct.mean(axis=0)).reshape(*grid, 3))
    exact = reduce(indirect.falling(np.where(indirect.lit[..., None], reach, 0).astype(np.float32)))
    ratio = np.divide(exact, white, out=np.ones_like(white), where=white > 0)
    ratio = np.clip(ratio, 1 / MOST_CORRECTION, MOST_CORRECTION)
    sampled = np.stack([bare.samples(image) for image in (reduce(indirect.scale) * ratio, reduce(black))] + [direct])
    surface = reduce(indirect.scale * inverse) * ratio * np.float32(unit)
    return LiveIndirect(factors, grid, side, places, sampled.astype(np.float32), surface.astype(np.float16))


def paint_map(indirect: IndirectLight, inverse: FloatImage, reduce: Reduce) -> npt.NDArray[np.float16] | None:
    """``LiveMaps.paint`` of colours that depend on the paint; None where they do not.

    ``inverse``, ``reduce``: as of ``indirect_maps``
    """
    unpainted = indirect.unpainted()
    if unpainted is None:
        return None
    base = np.divide(1, inverse, out=np.zeros_like(inverse), where=inverse > 0)
    rows = []
    for colour, of_each in enumerate(unpainted):
        added = np.moveaxis(of_each, 0, 2).astype(np.float32) * base * inverse[..., colour, None]
        rows.append(reduce(np.clip(added, -MOST_PAINT, MOST_PAINT)))
    return np.stack(rows, axis=2).astype(np.float16)


def _merged(factors: FloatImage, grid: tuple[int, int], merged: int) -> tuple[FloatImage, tuple[int, int]]:
    """Of blocks ``merged`` times as wide and high, whose means count what lies beyond the picture as dark."""
    coarse = -(-grid[0] // merged), -(-grid[1] // merged)
    row, column = np.divmod(np.arange(grid[0] * grid[1]), grid[1])
    member = np.zeros((coarse[0] * coarse[1], len(row)), np.float32)
    member[(row // merged) * coarse[1] + column // merged, np.arange(len(row))] = 1
    count = member.sum(axis=1)
    found = (member / count[:, None]) @ factors @ (member.T * (merged**2 / count))
    return np.ascontiguousarray(found, np.float32), coarse


def _places(
    grid: tuple[int, int], side: float, size: tuple[int, int]
) -> tuple[npt.NDArray[np.uint16], npt.NDArray[np.bool_]]:
    """(samples, blocks, 2) rows and columns of an even lattice in each block; whether they lie in the picture."""
    number = np.arange(SAMPLES)
    part = (np.stack([number, GENERATOR * number % SAMPLES], axis=-1) + 0.5) / SAMPLES
    first = np.stack(np.divmod(np.arange(grid[0] * grid[1]), grid[1]), axis=-1)
    at = np.floor((first + part[:, None]) * side).astype(np.int64)
    inside = channels.every(at < np.array(size))
    return np.minimum(at, np.array(size) - 1).astype(np.uint16), inside
