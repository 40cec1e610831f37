"""The shape of the response by the coarse sinusoids, which light from other surfaces hardly changes.

A projector shows the sinusoids by the response that is known when they are photographed. Where that is wrong, they are
no sinusoids in light. What reaches a camera pixel is c + a w(x - shift): c, light that is not modulated, and a, the
direct light, are unknown in each small part of the picture, and w, the wave, is the same in all of it. c and a change
the wave's first harmonic and its mean, as blur and light between near surfaces do. An error of the response has higher
harmonics, too: by these, w is found at the values of device light that the sinusoids show, 0 at black and 1 at white.

Device values are whole numbers, and what one pixel lacks its neighbours get (``encode_frame``). In a sinusoid this
leaves whole lines brighter or darker than asked for, by up to 0.001 of white. The frames are known, so that is, too.
How much of it a camera pixel sees depends on its blur, which is measured only nearly: each colour has some of its own,
and a place that is not quite right blurs, too.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from controller.core import channels
from controller.core.arrays import ByteImage, Float64, FloatImage, Mask
from controller.optics.calibrate.correspondence.captures import Captures, coloured, lit_pixels
from controller.optics.calibrate.photometry.tile_fit import rising
from controller.optics.calibrate.values import PhaseMap, Radiometry
from controller.optics.capture.pattern_frames import device_frame
from controller.optics.capture.patterns import PERIOD_PX, PatternPlan

COARSE: Final = ("phase-x", "phase-y")
HALF: Final = PERIOD_PX // 2
"""Projector pixels from the dark middle of a wave to the bright one."""
ANGLES: Final[Float64] = np.pi * np.arange(HALF + 1) / HALF
ASKED: Final[Float64] = 0.5 - 0.5 * np.cos(ANGLES)
"""The 13 levels of light that a sinusoid asks of a whole projector pixel, from black to white."""
PART_PX: Final = 8
"""A part of the picture is a square with sides of so many projector pixels: the period of what harmonics do to three
steps."""
PIXELS: Final = 96
"""So many camera pixels of a part are used, some of them twice where it has fewer."""
FEWEST_PIXELS: Final = 48
"""A part with fewer camera pixels is left out."""
MOST_PARTS: Final = 2000
FEWEST_PARTS: Final = 60
FRAME_PX: Final = 6
"""So many projector pixels at the frame's border are omitted: there is no wave beyond it."""
OUTLIER: Final = 5.0
"""Light that differs from the fit by more than so many standard deviations is left out."""
DARK_NOISE: Final = 0.03
"""The variance of a camera pixel's light is that of white, times the sum of its share of white and this."""
CONTRAST_LEFT: Final = 0.2, 1.5
"""A part whose direct light is not between these shares of white does not show a single surface; it is left out."""
FLICKER: Final = 0.01
"""Standard deviation of a lamp's strength from one photograph to the next."""
BLUR_PX2: Final = 0.1
"""A colour's blur is larger than was measured, by this standard deviation, in projector pixels squared."""
BEND: Final = 0.001
"""Standard deviation of the second differences, from one level to the next, of what is added to a tiles' response."""
SIGMA: Final = 0.00045
"""Standard deviation of a level apart from noise, as a share of white: the blur is not quite a Gaussian, and light
between near surfaces is modulated a little."""
TILES_SIGMA: Final = 0.0005
"""Standard deviation of a tiles' response, as a share of white, where no light is indirect."""
TILES_SIGMA_OF_SHARE: Final = 0.01
"""The share of indirect light, times this, adds to ``TILES_SIGMA``."""
OVERSAMPLED: Final = 32
"""Places in each projector pixel for which the levels' shares are tabulated."""
VARIANCES_PX2: Final[Float64] = np.geomspace(0.05, 16, 40)
"""Blurs for which they are tabulated, in projector pixels squared."""


@dataclass(frozen=True, slots=True)
class Wave:
    """The steps of one sinusoid, ``parts`` of the picture with ``PIXELS`` camera pixels each.

    ``ratio`` (parts, pixels, steps, 3): light over white; ``weight`` (parts, pixels, 3): white, of the brightest
    ``levels`` (parts, pixels, steps, 13): how much of each of ``ASKED`` a camera pixel gets
    ``blurred`` (parts, pixels, steps, 13): change of ``levels`` with the blur, per projector pixel squared
    ``moved`` (parts, pixels, steps): change of the asked light with the place, per projector pixel
    ``values`` (13, 256, 3): share of each device value in the projector's pixels that were asked for a level
    """

    ratio: Float64
    weight: Float64
    levels: npt.NDArray[np.float32]
    blurred: npt.NDArray[np.float32]
    moved: Float64
    values: Float64

    def light(self, response: Float64) -> Float64:
        """(13, 3) mean light of the pixels that were asked for each level, by a response (3, 256)."""
        return np.asarray(np.einsum("lvc,cv->lc", self.values, response), np.float64)


def coarse_waves(
    captures: Captures, plan: PatternPlan, white: FloatImage, phase_map: PhaseMap, valid: Mask, shown_with: Float64
) -> tuple[Wave, ...]:
    """What the photographs show of the coarse sinusoids, for ``held_to``; none where that is too little.

    Parameters
    ----------
    captures : linear photographs in one unit; needs ``black`` and ``phase-*``
    white : (rows, columns, 3) less the black image, NaN where not known
    phase_map, valid : where the camera pixels look, and which are known. From a plan whose opposites are computed
        nothing can be said: they contradict no response
    shown_with : (3, 256) the response by which the sinusoids were encoded

    Raises CalibrationError("capture-missing") or CalibrationError("capture-shape-wrong").
    """
    if plan.computed:
        return ()
    black = coloured(captures, "black", white.shape[:2])
    lit = lit_pixels(white) & valid & channels.finite(phase_map.projector_px)
    pixels = _parts(phase_map.projector_px, lit, plan.size_px)
    if len(pixels) < FEWEST_PARTS:
        return ()
    bright = np.percentile(white[lit][::7], 99, axis=0)
    table = _table()
    change = _changes(table)
    sine = table @ ASKED[:, None]
    waves = []
    for axis, prefix in enumerate(COARSE):
        steps = plan.sinusoids(prefix)
        # One photograph after the other: all of them would be too much memory for a large camera.
        light = np.stack([_colours(captures, step.name, black, pixels) for step in steps], axis=2)
        full = white.reshape(-1, 3)[pixels].astype(np.float64)
        complete = np.asarray(np.isfinite(light).all(axis=(2, 3)), np.bool_)
        ratio = np.where(complete[:, :, None, None], light / full[:, :, None], 0)
        weight = np.where(complete[..., None], np.minimum(full / bright, 1), 0)
        place = phase_map.projector_px.reshape(-1, 2)[pixels].astype(np.float64)
        variance = _variance(phase_map.spread_px2, place, axis)
        shifts = [round(step.phase_rad / (2 * np.pi) * PERIOD_PX) for step in steps]
        levels, blurred = (
            np.stack(
                [_levels(shares, place[..., axis] - shift, variance).astype(np.float32) for shift in shifts], axis=2
            )
            for shares in (table, change)
        )
        apart = 1 / OVERSAMPLED
        ahead, behind = (
            np.stack([_levels(sine, place[..., axis] - shift + step, variance) for shift in shifts], axis=2)[..., 0]
            for step in (apart, -apart)
        )
        values = _values((device_frame(step, plan.size_px, shown_with) for step in steps), shifts, axis)
        waves.append(Wave(ratio, weight, levels, blurred, (ahead - behind) / (2 * apart), values))
    return tuple(waves)


def _values(frames: Iterable[ByteImage], shifts: Sequence[int], axis: int) -> Float64:
    """``Wave.values`` of the steps' frames (rows, columns, 3), of sinusoids along ``axis`` at ``shifts``."""
    counts = np.zeros((HALF + 1, 256, 3))
    for frame, shift in zip(frames, shifts, strict=True):
        lines = frame if axis == 1 else frame.swapaxes(0, 1)
        level = _level(np.arange(len(lines)) - shift)
        for channel in range(3):
            pair = level[:, None] * 256 + lines[..., channel]
            counts[..., channel] += np.bincount(pair.ravel(), minlength=counts[..., 0].size).reshape(-1, 256)
    return np.asarray(counts / counts.sum(axis=1, keepdims=True), np.float64)


def _colours(captures: Captures, name: str, black: FloatImage, pixels: npt.NDArray[np.int64]) -> Float64:
    """(parts, pixels, 3) light of a photograph, less black, NaN where it is not known."""
    picture = coloured(captures, name, black.shape[:2]).reshape(-1, 3)[pixels]
    return np.asarray(picture - black.reshape(-1, 3)[pixels], np.float64)


def held_to(
    waves: tuple[Wave, ...],
    radiometry: Radiometry,
    shown_with: Float64,
    share: FloatImage,
    white: FloatImage,
    near: Float64 | None = None,
) -> Radiometry:
    """The radiometry, its responses held to the waves as far as they are surer than colour tiles.

    Parameters
    ----------
    waves : of ``coarse_waves``; without any, nothing changes
    radiometry : from colour tiles
    shown_with : (3, 256) the response by which the sinusoids were encoded
    share : (rows, columns, 3) of the projector's white (rows, columns, 3) that is indirect light
    near : (3, 256) the response of an earlier pass: how much each pixel counts depends on what it leaves of the light;
        that of the tiles if omitted
    """
    if not waves:
        return radiometry
    added, sigma = _measured(waves, radiometry, radiometry.response if near is None else near)
    lit = lit_pixels(white)
    indirect = float(np.median(share[lit])) if lit.any() else 0.0
    of_tiles = TILES_SIGMA**2 + (TILES_SIGMA_OF_SHARE * indirect) ** 2
    change = of_tiles / (of_tiles + SIGMA**2 + sigma**2) * added
    curves = [
        rising(curve + _between(at_levels, np.arccos(np.clip(1 - 2 * encoded, -1, 1))))
        for curve, at_levels, encoded in zip(radiometry.response, change, shown_with, strict=True)
    ]
    return dataclasses.replace(radiometry, response=np.stack(curves))


def _between(change: Float64, angle: Float64) -> Float64:
    """A change at ``ANGLES``, (13,), at any: flat at both ends, so that it vanishes with the light."""
    from scipy.interpolate import CubicSpline

    return np.asarray(CubicSpline(ANGLES, change, bc_type="clamped")(angle), np.float64)


def _measured(waves: tuple[Wave, ...], radiometry: Radiometry, near: Float64) -> tuple[Float64, Float64]:
    """(3, 13) what is to be added to each channel's light at ``ASKED``, and its standard deviation by noise.

    ``near``: (3, 256) a response near to the one that is sought
    """
    inner = HALF - 1  # unknown levels: black and white are fixed
    bend = np.diff(np.eye(HALF + 1), 2, axis=0)[:, 1:-1] / BEND
    # normal equations of the unknown levels of red, green and blue in turn, (33, 33) and (33,)
    matrix = np.kron(np.eye(3), bend.T @ bend)
    by_tiles, by_near = (
        [radiometry.emitted(wave.light(response)).T for wave in waves] for response in (radiometry.response, near)
    )
    mean = np.mean(by_tiles, axis=0)
    added, sigma = np.mean(by_near, axis=0) - mean, np.zeros((3, HALF + 1))
    right = -matrix @ added[:, 1:-1].ravel()
    for wave, light in zip(waves, by_tiles, strict=True):
        for channel, (of_camera, value) in enumerate(_normals(wave, radiometry.mixing @ (light + added))):
            # (11, 33): a camera channel sees each level as the mixture of the projector's three
            to_camera = np.kron(radiometry.mixing[channel], np.eye(inner))
            matrix += to_camera.T @ of_camera @ to_camera
            right += to_camera.T @ value
    covariance = np.linalg.inv(matrix)
    added[:, 1:-1] += (covariance @ right).reshape(3, inner)
    sigma[:, 1:-1] = np.sqrt(np.diag(covariance)).reshape(3, inner)
    return (radiometry.channels((mean + added).T) - radiometry.channels(mean.T)).T, sigma


def _normals(wave: Wave, expected: Float64) -> Iterator[tuple[Float64, Float64]]:
    """Of each camera channel: normal matrix (11, 11) and right side of what is to be added to the ``expected`` levels.

    ``expected`` (3, 13). In each part, light that is not modulated, direct light, and a shift of the wave are free, and
    over all parts the lamp's strength in each photograph, and the blur.
    """
    parts, pixels, steps, _ = wave.levels.shape
    rows = pixels * steps
    inner = wave.levels[..., 1:-1].reshape(parts, rows, -1)
    photograph = np.tile(np.eye(steps), (pixels, 1))
    common_sigma = np.array([FLICKER] * steps + [BLUR_PX2])
    moved = wave.moved.reshape(parts, rows)
    for channel in range(3):
        model, blurred = ((shares @ expected[channel]).reshape(parts, rows) for shares in (wave.levels, wave.blurred))
        light = wave.ratio[..., channel].reshape(parts, rows)
        free = np.stack([np.ones_like(model), model, moved], axis=2)
        weight = np.repeat(wave.weight[..., channel], steps, axis=1) / (DARK_NOISE + np.clip(model, 0, 1))
        fit = _PartFit(free, weight)
        deviation = np.abs(fit.residual(light)) * np.sqrt(weight)
        weight *= deviation < OUTLIER * 1.4826 * np.median(deviation, axis=1, keepdims=True) + 1e-12
        fit = _PartFit(free, weight)
        residual = fit.residual(light)
        direct = fit.solved(light[..., None])[:, 1, 0]
        usable = (direct > CONTRAST_LEFT[0]) & (direct < CONTRAST_LEFT[1])
        # unknowns: the levels, the strength of each photograph, and the blur; less what the free ones explain
        strength = (light - residual)[..., None] * photograph
        blur = (blurred * direct[:, None])[..., None]
        columns = np.concatenate([inner * direct[:, None, None], strength, blur], axis=2)
        columns -= free @ fit.solved(columns)
        count = np.maximum(np.count_nonzero(weight, axis=1) - free.shape[2], 1)
        variance = np.maximum(np.sum(weight * residual**2, axis=1) / count, 1e-12)
        weight *= (usable / variance)[:, None]
        weighted = (columns * weight[..., None]).reshape(parts * rows, -1)
        matrix = weighted.T @ columns.reshape(weighted.shape)
        right = weighted.T @ residual.ravel()
        yield _without(common_sigma, matrix, right)


class _PartFit:
    """Weighted least squares in every part by the columns ``free`` (parts, rows, n); ``weight`` (parts, rows)."""

    def __init__(self, free: Float64, weight: Float64) -> None:
        self._free = free
        self._weighted = np.swapaxes(free * weight[..., None], 1, 2)
        self._matrix = self._weighted @ free + 1e-9 * np.eye(free.shape[2])

    def solved(self, values: Float64) -> Float64:
        """(parts, n, k): how much of each column there is in values (parts, rows, k)."""
        return np.asarray(np.linalg.solve(self._matrix, self._weighted @ values), np.float64)

    def residual(self, light: Float64) -> Float64:
        """(parts, rows): what the columns leave of the light (parts, rows)."""
        return np.asarray(light - (self._free @ self.solved(light[..., None]))[..., 0], np.float64)


def _without(sigma: Float64, matrix: Float64, right: Float64) -> tuple[Float64, Float64]:
    """Normal equations without their last unknowns, which are 0 with standard deviations ``sigma``."""
    first = len(right) - len(sigma)
    last = matrix[first:, first:] + np.diag(1 / sigma**2)
    eliminated = np.linalg.solve(last, np.column_stack([matrix[first:, :first], right[first:]]))
    across = matrix[:first, first:]
    return matrix[:first, :first] - across @ eliminated[:, :-1], right[:first] - across @ eliminated[:, -1]


def _parts(place_px: FloatImage, used: Mask, size_px: tuple[int, int]) -> npt.NDArray[np.int64]:
    """(parts, PIXELS) flat numbers of camera pixels: parts spread over the picture, and pixels over each part."""
    edge = np.array(size_px) - 1 - FRAME_PX
    with np.errstate(invalid="ignore"):
        inside = used & np.all((place_px >= FRAME_PX) & (place_px <= edge), axis=2)
    pixels = np.flatnonzero(inside)
    column, row = (place_px.reshape(-1, 2)[pixels] // PART_PX).astype(np.int64).T
    part = row * (size_px[0] // PART_PX + 1) + column
    order = np.argsort(part, kind="stable")
    _, first, count = np.unique(part[order], return_index=True, return_counts=True)
    full = np.flatnonzero(count >= FEWEST_PIXELS)
    if full.size > MOST_PARTS:
        full = full[np.arange(MOST_PARTS) * full.size // MOST_PARTS]
    taken = (np.arange(PIXELS) * count[full, None]) // PIXELS
    return np.asarray(pixels[order[first[full, None] + taken]], np.int64)


def _variance(spread_px2: FloatImage, place: Float64, axis: int) -> Float64:
    """Blur along an axis at places (..., 2) of the projector's image, in projector pixels squared."""
    rows, columns = spread_px2.shape[:2]
    variance = spread_px2[..., 2 * axis].astype(np.float64)
    finite = variance[np.isfinite(variance)]
    usual = float(np.median(finite)) if finite.size else float(VARIANCES_PX2[0])
    column = np.clip(np.rint(place[..., 0]), 0, columns - 1).astype(np.int64)
    row = np.clip(np.rint(place[..., 1]), 0, rows - 1).astype(np.int64)
    return np.asarray(np.where(np.isfinite(variance), variance, usual)[row, column], np.float64)


def _table() -> Float64:
    """(variances, places, 13): share of each level in the light at a place of a period, for each blur."""
    place = np.arange(PERIOD_PX * OVERSAMPLED) / OVERSAMPLED
    shares = np.zeros((VARIANCES_PX2.size, place.size, HALF + 1))
    for number, variance in enumerate(VARIANCES_PX2):
        reach = int(np.ceil(4.5 * np.sqrt(variance))) + 1
        pixel = np.arange(-reach, PERIOD_PX + reach + 1)
        kernel = np.exp(-((place[:, None] - pixel) ** 2) / (2 * variance))
        kernel[np.abs(place[:, None] - pixel) > reach] = 0
        kernel /= kernel.sum(axis=1, keepdims=True)
        shares[number] = kernel @ np.eye(HALF + 1)[_level(pixel)]
    return shares


def _changes(table: Float64) -> Float64:
    """Change of ``table`` (variances, places, 13) with the variance."""
    return np.asarray(np.gradient(table, VARIANCES_PX2, axis=0), np.float64)


def _level(pixel: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Which of ``ASKED`` a sinusoid asks of a projector's pixel, counted from its brightest."""
    within = pixel % PERIOD_PX
    return np.asarray(HALF - np.minimum(within, PERIOD_PX - within), np.int64)


def _levels(table: Float64, place_px: Float64, variance: Float64) -> Float64:
    """(..., n) of ``table`` (variances, places, n), as ``_table``, at places and variances (...)."""
    place = np.rint(place_px * OVERSAMPLED).astype(np.int64) % table.shape[1]
    log = np.log(np.clip(variance, VARIANCES_PX2[0], VARIANCES_PX2[-1]))
    number = np.interp(log, np.log(VARIANCES_PX2), np.arange(VARIANCES_PX2.size))
    below = np.minimum(number.astype(np.int64), VARIANCES_PX2.size - 2)
    above = (number - below)[..., None]
    return np.asarray(table[below, place] * (1 - above) + table[below + 1, place] * above, np.float64)
