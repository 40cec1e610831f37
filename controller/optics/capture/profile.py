"""Properties of the camera measured during a run, and their file beside the photographs.

Its noise is measured from pairs of photographs of one still picture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from controller.core.arrays import Float64, FloatImage, load_arrays, save_arrays

FILE_NAME = "camera.npz"
SAME_EXPOSURE = 1e-6


LEFT_BY_INTERPOLATION: Final = (0.5625, 0.625, 0.5625)
"""The mean variance of red, green and blue by bilinear interpolation, relative to that of a sample."""


@dataclass(frozen=True, slots=True)
class CameraNoise:
    """Variance of a full-scale value v: ``shot`` v + ``read`` squared. The defaults suit a 12-bit APS-C camera."""

    shot: float = 1 / 30_000
    read: float = 6 / 30_000

    def per_second(self, exposure_s: float) -> CameraNoise:
        """The same of values in full scales per second, from photographs of this exposure."""
        return CameraNoise(self.shot / exposure_s, self.read / exposure_s)

    def variance(self, values: FloatImage, *, interpolated: bool) -> FloatImage:
        """Of ``values`` (rows, columns, 3), NaN where they are; ``interpolated``: from a mosaic, which takes some away.

        A channel's samples, and means of two and of four of them, alternate.
        """
        left = np.array(LEFT_BY_INTERPOLATION if interpolated else (1.0, 1.0, 1.0), np.float32)
        return np.asarray(left * (np.float32(self.shot) * np.maximum(values, 0) + np.float32(self.read**2)), np.float32)


def _nothing_clips() -> Float64:
    return np.full((2, 2), np.inf)


def _nothing_added() -> Float64:
    return np.zeros((2, 2))


def _no_corrections() -> Float64:
    return np.empty((0, 2))


def _none_bad() -> npt.NDArray[np.int64]:
    return np.empty((0, 2), np.int64)


@dataclass(frozen=True, slots=True)
class CameraProfile:
    """Measured properties of the camera; with the defaults, the values of each file are used.

    ``noise`` of one raw sample (JPEG: of one value in linear light)
    ``black_offset`` (2, 2) raw steps by which each site's black level lies above the file's value
    ``clip`` (2, 2) raw value from which a site saturates or is no longer linear, inf where none was found
    ``exposures`` (n, 2) reported and true exposures in seconds; those that are not listed are true as reported
    ``bad_px`` (n, 2) column and row of samples that do not measure light
    ``response`` (3, 256) linear light of a JPEG value, 1 at 255; None for a camera that delivers RAW
    """

    noise: CameraNoise = field(default_factory=CameraNoise)
    black_offset: Float64 = field(default_factory=_nothing_added)
    clip: Float64 = field(default_factory=_nothing_clips)
    bad_px: npt.NDArray[np.int64] = field(default_factory=_none_bad)
    exposures: Float64 = field(default_factory=_no_corrections)
    response: Float64 | None = None

    def true_exposure(self, reported_s: float) -> float:
        """Seconds for which the shutter really opens when the camera reports ``reported_s``."""
        for reported, true in self.exposures:
            if abs(reported / reported_s - 1) < SAME_EXPOSURE:
                return float(true)
        return reported_s

    def knows(self, reported_s: float) -> bool:
        """Whether the time of an exposure that the camera reports as ``reported_s`` was measured, and is corrected."""
        return any(abs(reported / reported_s - 1) < SAME_EXPOSURE for reported in self.exposures[:, 0])

    def save(self, folder: Path) -> Path:
        """Write ``camera.npz`` into a run's folder."""
        arrays: dict[str, npt.NDArray[np.generic]] = {
            "noise": np.array([self.noise.shot, self.noise.read]),
            "black_offset": self.black_offset,
            "clip": self.clip,
            "bad_px": self.bad_px,
            "exposures": self.exposures,
        }
        if self.response is not None:
            arrays["response"] = self.response
        save_arrays(folder / FILE_NAME, arrays)
        return folder / FILE_NAME


def true_exposure(profile: CameraProfile | None, reported_s: float) -> float:
    """As ``CameraProfile.true_exposure``; as the camera reports where nothing was measured of it."""
    return reported_s if profile is None else profile.true_exposure(reported_s)


def load_profile(folder: Path) -> CameraProfile | None:
    """What a run measured of its camera, None before it has."""
    path = folder / FILE_NAME
    if not path.exists():
        return None
    arrays = load_arrays(path)
    shot, read = (float(value) for value in arrays["noise"])
    return CameraProfile(
        noise=CameraNoise(shot, read),
        black_offset=arrays["black_offset"],
        clip=arrays["clip"],
        bad_px=arrays["bad_px"],
        exposures=arrays["exposures"],
        response=arrays.get("response"),
    )


BLOCK = 8
"""Samples of one site along a block's side: small enough for one ratio, large enough for a variance."""
FEWEST_BLOCKS = 60
MOST_BLOCKS = 8000
"""Of one site of one pair: more blocks only cost memory."""
ROUNDS = 12
OUTLIER = 4.0
"""Standard deviations of a block's variance: beyond this, something moved or an edge did not fit."""
SMALLEST = 1e-12
DARK_SHARE = 1e-4
"""Below this mean a block has no ratio: both photographs are black."""


@dataclass(frozen=True, slots=True)
class NoiseReport:
    """``noise`` measured; ``blocks`` it rests on; ``misfit`` median ratio of measured to modelled variance, near 1."""

    noise: CameraNoise
    blocks: int
    misfit: float


def measure_noise(pairs: Sequence[tuple[FloatImage, FloatImage]]) -> NoiseReport | None:
    """Shot and read noise of a raw sample, by least squares on the variances of small blocks.

    Both photographs of a pair show the same picture, at the same or at different exposures: in each block of one
    colour's samples the second is the first times a ratio, which is fitted, and what is left over is noise:
    var = v(second) + ratio^2 v(first), with v(s) = shot s + read^2.

    Parameters
    ----------
    pairs : of (rows, columns) float32 raw samples in full scale (``RawMosaic.linear``), NaN where clipped or bad.
        (For a JPEG, a channel in linear light.)

    Returns
    -------
    None where there are too few whole blocks, or nothing but darkness, to separate shot noise from read noise
    """
    blocks = [_blocks(first[r::2, c::2], second[r::2, c::2]) for first, second in pairs for r, c in np.ndindex(2, 2)]
    rows = np.concatenate(blocks) if blocks else np.empty((0, 3))
    if len(rows) < FEWEST_BLOCKS:
        return None
    shot, read2, kept = _fit(rows)
    if shot <= 0:
        return None
    ratio = rows[kept, 2] / (shot * rows[kept, 0] + read2 * rows[kept, 1])
    noise = CameraNoise(shot=float(shot), read=float(np.sqrt(max(read2, SMALLEST))))
    return NoiseReport(noise, int(np.count_nonzero(kept)), float(np.median(ratio)))


def _blocks(first: FloatImage, second: FloatImage) -> Float64:
    """(n, 3) of each whole block: factor of the shot noise, factor of the read noise, and the variance left over."""
    x, y = _tiles(first), _tiles(second)
    whole = np.isfinite(x).all(axis=1) & np.isfinite(y).all(axis=1)
    x, y = x[whole], y[whole]
    if not len(x):
        return np.empty((0, 3))
    mean_x, mean_y = x.mean(axis=1), y.mean(axis=1)
    # The ratio of the means: a regression on a noisy picture would come out too small.
    lit = mean_x > DARK_SHARE
    ratio = np.where(lit, mean_y / np.where(lit, mean_x, 1.0), 1.0)
    left = y - ratio[:, None] * x
    left -= left.mean(axis=1, keepdims=True)
    variance = np.sum(left**2, axis=1) / (x.shape[1] - 1)
    signal = np.maximum(mean_y, 0) + ratio**2 * np.maximum(mean_x, 0)
    return np.stack((signal, 1 + ratio**2, variance), axis=1)


def _tiles(samples: FloatImage) -> Float64:
    rows, columns = (side // BLOCK * BLOCK for side in samples.shape)
    tiles = samples[:rows, :columns].reshape(rows // BLOCK, BLOCK, columns // BLOCK, BLOCK)
    tiles = tiles[:: max(1, -(-rows * columns // (BLOCK * BLOCK * MOST_BLOCKS)))]
    return tiles.transpose(0, 2, 1, 3).reshape(-1, BLOCK * BLOCK).astype(np.float64)


def _fit(rows: Float64) -> tuple[float, float, np.ndarray[tuple[int], np.dtype[np.bool_]]]:
    """Weighted non-negative least squares of variance = shot signal + read^2 factor; outlying blocks left out.

    A variance from n samples has a relative standard deviation of sqrt(2 / (n - 1)), so its weight is 1 / model^2.
    """
    spread = np.sqrt(2 / (BLOCK * BLOCK - 2))
    kept = np.ones(len(rows), np.bool_)
    model = np.full(len(rows), max(float(np.median(rows[:, 2])), SMALLEST))
    shot, read2 = 0.0, 0.0
    for _ in range(ROUNDS):
        weighted = rows[kept] / model[kept, None]
        shot, read2 = _two_unknowns(weighted[:, :2], weighted[:, 2])
        model = np.maximum(shot * rows[:, 0] + read2 * rows[:, 1], SMALLEST)
        kept = np.abs(rows[:, 2] / model - 1) < OUTLIER * spread
        if np.count_nonzero(kept) < FEWEST_BLOCKS:
            # The model is still far off: take the typical block as a scale and continue with all of them.
            kept[:] = True
            model *= max(float(np.median(rows[:, 2] / model)), SMALLEST)
    return shot, read2, kept


def _two_unknowns(columns: Float64, wanted: Float64) -> tuple[float, float]:
    """Least squares for two unknowns >= 0: the best of the inner solution and the two edges."""
    normal, right = columns.T @ columns, columns.T @ wanted
    if np.linalg.det(normal) > SMALLEST * normal[0, 0] * normal[1, 1]:
        inner = np.linalg.solve(normal, right)
        if inner.min() >= 0:
            return float(inner[0]), float(inner[1])
    edges = [np.maximum(right[k], 0) / max(normal[k, k], SMALLEST) for k in range(2)]
    gains = [right[k] ** 2 / max(normal[k, k], SMALLEST) for k in range(2)]
    return (float(edges[0]), 0.0) if gains[0] >= gains[1] else (0.0, float(edges[1]))
