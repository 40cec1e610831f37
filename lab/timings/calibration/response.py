"""The response of a JPEG camera: photographs that took no part in it are predicted, and OpenCV's Debevec does the same.

With ``VELATURA_DATA`` and a folder ``memorial`` in it, the series is that of Debevec and Malik (1997): their
``memorial0061.png`` to ``memorial0076.png`` (32 s to 1/1024 s, scanned film) and ``memorial.hdr``, their own radiance
map. Else it is made here, by a camera whose curves are sigmoids of log exposure above a fog, as film has.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt

from controller.core.arrays import Float64, FloatImage
from controller.optics.capture.brackets import merge_brackets
from controller.optics.capture.jpeg_response import measure_response
from lab.timings import Row, at_most

EXPOSURES_S: Final = tuple(32 / 2**k for k in range(16))
SIZES_PX: Final = {"small": (240, 320), "medium": (480, 640), "paper": (768, 1024)}
INNER: Final = slice(40, 720), slice(30, 480)
"""Of a memorial photograph: without the border that its registration left."""
CLIPPED: Final = 250
BIAS_GOAL = 4.4
"""Device values: OpenCV's worst figure at the exposures that the goal was set for."""
MAP_GOAL = 0.07
"""Stops, median, each channel's scale taken out."""

Bytes = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Series:
    """Photographs (rows, columns, 3) uint8, their exposures, and the radiance to compare with, of any scale."""

    name: str
    images: list[Bytes]
    exposures_s: tuple[float, ...]
    radiance: Float64


def measure(size: str) -> list[Row]:
    """Predict every photograph of the series but the outermost from the others; compare the merged radiance."""
    series = memorial() or film(SIZES_PX[size])
    inner = range(1, len(series.images) - 1)
    ours, theirs = ([held_out(series, k, how) for k in inner] for how in (our_response, opencv_response))
    worst, worst_theirs = (float(np.max(np.abs(errors))) for errors in (ours, theirs))
    how = f"{series.name}; largest of {len(inner)} mean errors of a photograph that took no part"
    rows = [
        at_most("held-out photograph, ours", worst, BIAS_GOAL, unit="values", how=how),
        at_most("held-out photograph, OpenCV's", worst_theirs, None, unit="values", how=f"{how}, same merge"),
        at_most("held-out photograph, ours by OpenCV's", worst / worst_theirs, 1.0, unit="x", how="of the two above"),
    ]
    responses = our_response(series.images, series.exposures_s), opencv_response(series.images, series.exposures_s)
    own = off_by_stops(merged(series.images, series.exposures_s, responses[0]), series.radiance)
    times = np.array(series.exposures_s, np.float32)
    curve = np.ascontiguousarray(responses[1].T[:, None, :], np.float32)
    other = off_by_stops(cv2.createMergeDebevec().process(series.images, times, curve), series.radiance)
    return [
        *rows,
        at_most("merged radiance, ours", own, MAP_GOAL, unit="stops", how="worst channel's median from the reference"),
        at_most("merged radiance, OpenCV's", other, None, unit="stops", how="MergeDebevec with its own response"),
        at_most("merged radiance, ours by OpenCV's", own / other, 1.0, unit="x", how="of the two above"),
    ]


def memorial() -> Series | None:
    """Debevec's series from ``VELATURA_DATA``, None where it is not there."""
    folder = Path(os.environ.get("VELATURA_DATA", "")) / "memorial"
    paths = [folder / f"memorial00{number}.png" for number in range(61, 77)]
    if "VELATURA_DATA" not in os.environ or not all(path.is_file() for path in [*paths, folder / "memorial.hdr"]):
        return None
    images = [np.asarray(cv2.imread(str(path), cv2.IMREAD_COLOR_RGB), np.uint8)[INNER] for path in paths]
    radiance = np.asarray(cv2.imread(str(folder / "memorial.hdr"), cv2.IMREAD_UNCHANGED), np.float64)[INNER]
    return Series("memorial", [np.ascontiguousarray(one) for one in images], EXPOSURES_S, radiance[..., ::-1])


def film(shape: tuple[int, int], seed: int = 0) -> Series:
    """Smooth light over four decades on a film with fog, scanned; grain of one value."""
    rng = np.random.default_rng(seed)
    smooth = cv2.GaussianBlur(rng.standard_normal((*shape, 3)).astype(np.float32), (0, 0), shape[0] / 24)
    light = np.asarray(np.exp(1.8 * smooth / smooth.std()) / 4, np.float64)
    fog, gamma, speed = np.array([13.0, 17.0, 15.0]), np.array([1.5, 1.3, 1.4]), np.array([3.0, 2.0, 1.5])
    images = []
    for exposure_s in EXPOSURES_S:
        raised = (light * exposure_s * speed / 10) ** gamma
        value = fog + (265 - fog) * raised / (1 + raised) + rng.normal(0, 1, light.shape)
        images.append(np.clip(np.rint(value), 0, 255).astype(np.uint8))
    return Series("synthetic film", images, EXPOSURES_S, light)


def our_response(images: Sequence[Bytes], exposures_s: Sequence[float]) -> Float64:
    """(3, 256) by ``measure_response``."""
    return measure_response(images, exposures_s).table


def opencv_response(images: Sequence[Bytes], exposures_s: Sequence[float]) -> Float64:
    """(3, 256) by OpenCV's CalibrateDebevec with its own settings (more samples do worse here), 1 at 255 as ours is."""
    found = cv2.createCalibrateDebevec()
    table = found.process(list(images), np.array(exposures_s, np.float32))[:, 0, :].T.astype(np.float64)
    return np.asarray(table / table[:, -1:])


def merged(images: Sequence[Bytes], exposures_s: Sequence[float], table: Float64) -> FloatImage:
    """Radiance (rows, columns, 3) by ``merge_brackets``, NaN where every photograph is clipped."""
    linear = []
    for image in images:
        light = np.stack([table[c][image[..., c]] for c in range(3)], axis=-1).astype(np.float32)
        light[image >= CLIPPED] = np.nan
        linear.append(light)
    return merge_brackets(linear, exposures_s).radiance


def held_out(series: Series, left_out: int, response: Callable[[Sequence[Bytes], Sequence[float]], Float64]) -> float:
    """Mean error, in device values, of one photograph as the others predict it, where it is not clipped."""
    others = [k for k in range(len(series.images)) if k != left_out]
    images, exposures_s = [series.images[k] for k in others], [series.exposures_s[k] for k in others]
    table = response(images, exposures_s)
    light = merged(images, exposures_s, table) * series.exposures_s[left_out]
    actual = series.images[left_out]
    predicted = np.stack([values_of(light[..., c], table[c]) for c in range(3)], axis=-1)
    judged = np.isfinite(predicted) & (actual < CLIPPED)
    return float(np.mean(predicted[judged] - actual[judged]))


def values_of(light: FloatImage, curve: Float64) -> Float64:
    """The device values whose light this is; the highest of those that mean none, where there is none."""
    rising = np.maximum.accumulate(curve)
    return np.asarray(np.interp(light, rising, np.arange(rising.size)), np.float64)


def off_by_stops(found: npt.NDArray[Any], reference: Float64) -> float:
    """Median distance of the logarithms, of the worst channel; each channel has a scale of its own."""
    worst = 0.0
    for channel in range(3):
        one, other = found[..., channel], reference[..., channel]
        judged = np.isfinite(one) & (one > 0) & (other > 0)
        apart = np.log2(one[judged] / other[judged])
        worst = max(worst, float(np.median(np.abs(apart - np.median(apart)))))
    return worst
