"""Where a prediction is bad, and why: each camera pixel that errs gets the reason that its own data give."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from controller.core import channels
from controller.core.arrays import ByteImage, FloatImage, Mask
from controller.core.plotting import write
from controller.optics.calibrate.values import Calibration
from controller.optics.calibrate.verify.drift import TransportModel
from controller.optics.calibrate.verify.error_causes import COLOURS, WORDS, ErrorCause

NEAR_PX = 15
BAD = 0.05
"""A neighbourhood whose error exceeds this share of its light counts as bad."""
JUMP_PX = 2.0
"""Neighbouring camera pixels that see places this much farther apart on the projector's image than usual."""
STRETCHED = 3.0
"""Ratio of a projector pixel's sides as the camera sees it."""
BLURRED_PX = 1.2
"""Standard deviation in projector pixels."""
EXPLAINED = 0.5
"""A shift, or a change of brightness, is the reason where it explains this share of the squared error."""
INDIRECT_SHARE = 0.15
"""More indirect light than this share of what is seen, and an error no larger than it, is taken for the reason."""
UNDECODED_SHARE = 0.02
"""Of the brightest white: light without shares beyond it is missed."""
MOST_REASONS = 5


@dataclass(frozen=True, slots=True)
class ErrorAttribution:
    """``labels`` (rows, columns) uint8: a ``ErrorCause``; ``error`` (rows, columns) float32: squared, of all channels;

    ``lit`` (rows, columns): where the projector's light is expected
    """

    labels: npt.NDArray[np.uint8]
    error: FloatImage
    lit: Mask


def attribute_error(
    light: TransportModel,
    calibration: Calibration,
    n: int,
    shown: FloatImage,
    seen: FloatImage,
    *,
    variance: FloatImage,
    indirect: FloatImage | None = None,
) -> ErrorAttribution:
    """Find the reason at every camera pixel.

    Parameters
    ----------
    light : the light transport of ``calibration``
    shown : (rows, columns, 3) what projector ``n`` alone showed, linear light
    seen : (rows, columns, 3) its photograph, full scales per second, NaN where saturated
    variance : (rows, columns, 3) of that photograph's noise
    indirect : (rows, columns, 3) what else is expected of what was shown, by way of other surfaces
    """
    part = calibration.projectors[n]
    lit: Mask = np.asarray(light.lit[n], np.bool_)
    predicted = light.forward_part(n, shown)
    if indirect is not None:
        predicted = predicted + indirect
    measured = channels.finite(seen)
    light_seen = np.where(measured[:, :, None], seen - calibration.black, predicted).astype(np.float32)
    error = light_seen - predicted
    squared = np.where(lit & measured, channels.total(error * error), 0).astype(np.float32)
    power = channels.total(light_seen * light_seen)
    typical = float(power[lit].mean()) if lit.any() else 1.0
    near_error, near_power = _near(squared), _near(np.where(lit, power, 0))
    bad = lit & (near_error > BAD**2 * np.maximum(near_power, 1e-4 * typical))
    labels = np.where(bad, ErrorCause.UNEXPLAINED, ErrorCause.FINE).astype(np.uint8)

    def label(reason: ErrorCause, where: Mask, among: Mask) -> None:
        labels[among & where] = reason

    x, y, spread = _places(light, n, shown.shape)
    # From the last to the first: what is written later stands before.
    label(ErrorCause.DEFOCUS, spread > BLURRED_PX, bad)
    label(ErrorCause.GRAZING, _stretch(x, y) > STRETCHED, bad)
    label(ErrorCause.DARK, _near(np.where(lit & measured, channels.total(variance), 0)) > 0.5 * near_error, bad)
    moved, dimmed = _explained(light, n, shown, predicted, error, lit & measured)
    label(ErrorCause.DIMMED, dimmed > EXPLAINED, bad)
    if indirect is not None:
        near_indirect = _near(np.where(lit, channels.total(indirect * indirect), 0))
        much = near_indirect > INDIRECT_SHARE**2 * near_power
        by_lamp = _near(_without_lamp(light_seen, predicted, lit & measured)) > EXPLAINED * near_error
        label(ErrorCause.INDIRECT, much & by_lamp & (near_error < near_indirect), bad & (labels != ErrorCause.DARK))
    label(ErrorCause.MOVED, (moved > EXPLAINED) & (moved > dimmed), bad)
    label(ErrorCause.EDGE, _edges(x, y, lit), bad)
    bright = channels.smallest(part.white) > UNDECODED_SHARE * float(np.percentile(part.white, 99.9))
    label(ErrorCause.UNDECODED, bright & ~lit, calibration.object_mask)
    label(ErrorCause.SATURATED, ~measured, lit)
    return ErrorAttribution(labels, squared, lit)


def _without_lamp(seen: FloatImage, predicted: FloatImage, use: Mask) -> FloatImage:
    """The squared error, without what a lamp of another strength explains: such a lamp errs alike everywhere, light by
    way of other surfaces from place to place."""
    expected = np.where(use[:, :, None], predicted, np.float32(0))
    of_lamp = channels.products(np.where(use[:, :, None], seen, np.float32(0)), expected)
    of_lamp /= np.maximum(channels.products(expected, expected), 1e-30)
    rest = seen - of_lamp.astype(np.float32) * predicted
    return np.where(use, channels.total(rest * rest), np.float32(0))


def _near(image: npt.NDArray[Any]) -> FloatImage:
    return np.asarray(cv2.boxFilter(np.asarray(image, np.float32), -1, (NEAR_PX, NEAR_PX)), np.float32)


def _places(light: TransportModel, n: int, shape: tuple[int, ...]) -> tuple[FloatImage, FloatImage, FloatImage]:
    """x, y: where on the projector's image each camera pixel's light comes from; and how far it is spread there."""
    rows, columns = shape[:2]
    across, down = (axis / max(rows, columns) for axis in np.meshgrid(np.arange(columns), np.arange(rows)))
    ramps = np.stack([across, down, across**2 + down**2], axis=2).astype(np.float32)
    sums = [channels.total(light.forward_part(n, np.repeat(ramps[:, :, k : k + 1], 3, axis=2))) for k in range(3)]
    white = channels.total(light.forward_part(n, np.ones((rows, columns, 3), np.float32)))
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y, both = (np.where(white > 0, one / white, np.nan) * max(rows, columns) ** power
                      for one, power in zip(sums, (1, 1, 2), strict=True))  # fmt: skip
    spread = np.sqrt(np.maximum(np.nan_to_num(both - x**2 - y**2), 0) / 2)
    return x.astype(np.float32), y.astype(np.float32), spread.astype(np.float32)


def _slopes(x: FloatImage, y: FloatImage) -> tuple[FloatImage, ...]:
    """How x and y change from one camera pixel to the next: x by column, x by row, y by column, y by row."""
    (a, b), (c, d) = ((np.gradient(one, axis=1), np.gradient(one, axis=0)) for one in (x, y))
    return a, b, c, d


def _stretch(x: FloatImage, y: FloatImage) -> FloatImage:
    a, b, c, d = (cv2.medianBlur(np.nan_to_num(one).astype(np.float32), 5) for one in _slopes(x, y))
    half, det = (a * a + b * b + c * c + d * d) / 2, np.abs(a * d - b * c)
    most = np.sqrt(half + np.sqrt(np.maximum(half * half - det * det, 0)))
    return np.asarray(most * most / np.maximum(det, 1e-6), np.float32)


def _edges(x: FloatImage, y: FloatImage, lit: Mask) -> Mask:
    """Where neighbouring camera pixels look at far-off places, or at nothing on one side, widened by the blur."""
    a, b, c, d = _slopes(x, y)
    steps = np.hypot(np.hypot(a, b), np.hypot(c, d))
    known = steps[lit & np.isfinite(steps)]
    usual = float(np.median(known)) if known.size else 1.0
    jumps = (np.nan_to_num(steps) > usual + JUMP_PX) | (lit & ~np.isfinite(steps))
    return np.asarray(cv2.dilate(jumps.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0)


def _explained(
    light: TransportModel, n: int, shown: FloatImage, predicted: FloatImage, error: FloatImage, use: Mask
) -> tuple[FloatImage, FloatImage]:
    """The share of the squared error around each pixel that a small shift, or another brightness, would take away."""
    slopes = [light.forward_part(n, np.asarray(np.gradient(shown, axis=axis), np.float32)) for axis in (1, 0)]

    def around(one: FloatImage, other: FloatImage) -> FloatImage:
        return _near(np.where(use, channels.total(one * other), 0))

    ee = np.maximum(around(error, error), 1e-30)
    xx, xy, yy = around(slopes[0], slopes[0]), around(slopes[0], slopes[1]), around(slopes[1], slopes[1])
    ex, ey = around(slopes[0], error), around(slopes[1], error)
    det = xx * yy - xy * xy
    sound = det > 1e-3 * xx * yy
    taken = (yy * ex * ex - 2 * xy * ex * ey + xx * ey * ey) / np.where(sound, det, 1)
    moved = np.where(sound, taken, 0) / ee
    dimmed = around(predicted, error) ** 2 / np.maximum(around(predicted, predicted), 1e-30) / ee
    return np.asarray(moved, np.float32), np.asarray(dimmed, np.float32)


def ranked(why: ErrorAttribution) -> list[dict[str, Any]]:
    """The most important reasons by how much of the squared error they carry; ``sentence`` is for the technician."""
    total, pixels = max(float(why.error.sum(dtype=np.float64)), 1e-30), max(int(np.count_nonzero(why.lit)), 1)
    rows: list[tuple[float, dict[str, Any]]] = []
    for reason, (name, what, remedy) in WORDS.items():
        here = why.labels == reason
        count = int(np.count_nonzero(here))
        if not count:
            continue
        of_error, of_area = float(why.error[here].sum(dtype=np.float64)) / total, count / pixels
        if max(of_error, of_area) < 0.002:
            continue
        sentence = (
            f"{what[0].upper()}{what[1:]}, most of it {_where(here, why.lit)}: {100 * of_area:.1f} % of the lit area, "
            f"{100 * of_error:.0f} % of the error; {remedy}."
        )
        row = {"reason": name, "error_share": of_error, "area_share": of_area, "sentence": sentence}
        rows.append((max(of_error, of_area), row))
    return [row for _, row in sorted(rows, key=lambda one: one[0], reverse=True)[:MOST_REASONS]]


def _where(here: Mask, lit: Mask) -> str:
    """In which ninth of the lit part of the picture most of it lies."""
    y, x = np.nonzero(lit if lit.any() else here)
    top, left, high, wide = y.min(), x.min(), max(int(np.ptp(y)) + 1, 1), max(int(np.ptp(x)) + 1, 1)
    y, x = np.nonzero(here)
    ninth = np.clip((y - top) * 3 // high, 0, 2) * 3 + np.clip((x - left) * 3 // wide, 0, 2)
    most = int(np.bincount(ninth.astype(np.int64), minlength=9).argmax())
    if most == 4:
        return "in the middle"
    down, across = ("top ", "", "bottom ")[most // 3], ("left", "middle", "right")[most % 3]
    return f"at the {down}{across}"


def attribution_picture(why: ErrorAttribution, calibration: Calibration, name: str) -> ByteImage:
    """The labels in colour over the object in grey, with a legend below: (rows, columns, 3) uint8 RGB."""
    white = sum((channels.mean(part.white) for part in calibration.projectors), start=channels.mean(calibration.black))
    grey = (
        np.sqrt(np.clip(white / max(float(np.percentile(white[calibration.object_mask], 99)), 1e-30), 0, 1)) * 150 + 30
    )
    picture = np.repeat(np.rint(grey).astype(np.uint8)[:, :, None], 3, axis=2)
    for reason, colour in COLOURS.items():
        picture[why.labels == reason] = colour
    rows, columns = picture.shape[:2]
    scale = max(1, math.ceil(900 / columns))
    picture = cv2.resize(picture, (columns * scale, rows * scale), interpolation=cv2.INTER_NEAREST).astype(np.uint8)
    return np.concatenate([picture, _legend(why, name, picture.shape[1])], axis=0)


def _legend(why: ErrorAttribution, name: str, width: int) -> ByteImage:
    size = width / 1500
    line, per_line = int(58 * size), 3
    reasons = [reason for reason in COLOURS if np.any(why.labels == reason)]
    # As high for every projector, so that panels of one run can be distinguished by their height.
    band = np.full((line * (1 + math.ceil(len(COLOURS) / per_line)) + int(16 * size), width, 3), 24, np.uint8)
    write(band, f"projector {name}", (int(20 * size), int(30 * size)), round(42 * size), (235, 235, 235))
    for number, reason in enumerate(reasons):
        x, y = int((20 + 495 * (number % per_line)) * size), line * (1 + number // per_line)
        cv2.rectangle(band, (x, y + int(12 * size)), (x + int(34 * size), y + int(46 * size)), COLOURS[reason], -1)
        cv2.rectangle(band, (x, y + int(12 * size)), (x + int(34 * size), y + int(46 * size)), (160, 160, 160), 1)
        write(band, WORDS[reason][0], (x + int(48 * size), y + int(29 * size)), round(38 * size), (235, 235, 235))
    return band
