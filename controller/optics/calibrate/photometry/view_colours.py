"""Colour differences between views, measured where they overlap.

A projector pixel lights one place of the surface, so two views that see it see the same light of it. Strengths are
medians over such pixels, because highlights differ from view to view, and all pairs of views decide them together. The
colours of the projectors' red, green and blue there say how one camera sees what another one does.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, Mask, array_in_file
from controller.optics.calibrate.values import Calibration, ProjectorCalibration

FAINTEST: Final = 0.02
"""Of a projector's white: darker places are not compared."""
FEWEST_SHARED: Final = 100
"""Projector pixels that tell how two views differ."""
UNMEASURED: Final = 1e-3
"""Weight of views' mean light, which decides for views that overlap no other one."""


@dataclass(frozen=True, slots=True, eq=False)
class ViewColour:
    """How a view's light is brought to the units of the first view's.

    ``gain`` (3,): by which its channels are multiplied; ``to_xyz`` (3, 3): from then on to CIE XYZ, as of the first
    view where they overlap
    ``shared``: projector pixels that the view shares with others; ``rest``: the median relative difference of light
    between them that is left, 0 without any
    """

    gain: FloatImage
    to_xyz: Float64
    shared: int
    rest: float


def view_colours(calibrations: Sequence[Calibration]) -> list[ViewColour]:
    """Of each view; their projectors are the same, in the same order."""
    seen = [[_seen(part) for part in own.projectors] for own in calibrations]
    rows, right, weights = [], [], []
    shared = np.zeros(len(seen), np.int64)
    for one, other in combinations(range(len(seen)), 2):
        light, also = _both(seen[one], seen[other])
        row = np.zeros(len(seen))
        row[one], row[other] = 1, -1
        if len(light) >= FEWEST_SHARED:
            shared[[one, other]] += len(light)
            difference, weight = np.median(np.log(also / light), axis=0), len(light) ** 0.5
        else:
            difference, weight = np.log(_mean_light(seen[other]) / _mean_light(seen[one])), UNMEASURED
        rows.append(weight * row)
        right.append(weight * difference)
        weights.append(weight)
    # the first view's units are everybody's
    rows.append(np.eye(len(seen))[0] * max(weights, default=1.0))
    right.append(np.zeros(3))
    gains = np.exp(np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0])
    found = []
    for v, own in enumerate(calibrations):
        rest = _rest(seen, gains, v)
        to_xyz = own.camera_to_xyz / gains[v]
        if v and (to_first := _to_first(calibrations, seen, gains, v)) is not None:
            to_xyz = calibrations[0].camera_to_xyz @ to_first
        found.append(ViewColour(gains[v].astype(np.float32), to_xyz, int(shared[v]), rest))
    return found


def in_common_units(calibration: Calibration, colour: ViewColour, folder: Path) -> Calibration:
    """The same calibration, its light in the units of the first view's; large images are in nameless files."""

    def scaled(image: FloatImage) -> FloatImage:
        product = array_in_file(folder, image.shape)
        np.multiply(image, colour.gain, out=product)
        return product

    parts = tuple(
        dataclasses.replace(
            part, white=scaled(part.white), indirect=None if part.indirect is None else scaled(part.indirect)
        )
        for part in calibration.projectors
    )
    black = calibration.black * colour.gain
    return dataclasses.replace(calibration, projectors=parts, black=black, camera_to_xyz=colour.to_xyz)


def _seen(part: ProjectorCalibration) -> tuple[FloatImage, Mask]:
    """(pixels, 3) light of a projector's white where each of its pixels lands, and (pixels,) where that is known."""
    metapixels = part.metapixels
    x, y = np.moveaxis(np.where(metapixels.valid[..., None], metapixels.centre_px, -1).astype(np.float32), 2, 0)
    # the mean of a few pixels: a colour's own samples are two apart
    light = np.asarray(cv2.remap(cv2.blur(part.white, (3, 3)), x, y, cv2.INTER_LINEAR), np.float32).reshape(-1, 3)
    brightest = np.percentile(part.white[::4, ::4].max(axis=2), 99.9)
    return light, metapixels.valid.ravel() & (channels.smallest(light) > FAINTEST * brightest)


def _both(one: Sequence[tuple[FloatImage, Mask]], other: Sequence[tuple[FloatImage, Mask]]) -> tuple[Float64, Float64]:
    """(shared, 3): the light that both views see, all projectors one after the other."""
    pairs = [(a[valid & also], b[valid & also]) for (a, valid), (b, also) in zip(one, other, strict=True)]
    first, second = (np.concatenate([pair[k] for pair in pairs]).astype(np.float64) for k in (0, 1))
    return first, second


def _mean_light(seen: Sequence[tuple[FloatImage, Mask]]) -> Float64:
    light = np.concatenate([one[valid] for one, valid in seen])
    return np.asarray(light.mean(axis=0, dtype=np.float64)) if len(light) else np.ones(3)


def _rest(seen: Sequence[Sequence[tuple[FloatImage, Mask]]], gains: Float64, v: int) -> float:
    off = []
    for other in range(len(seen)):
        if other != v:
            light, also = _both(seen[v], seen[other])
            off.append(np.abs(np.log(light * gains[v] / (also * gains[other]))).mean(axis=1))
    every = np.concatenate(off) if off else np.zeros(0)
    return float(np.median(every)) if every.size else 0.0


def _to_first(
    calibrations: Sequence[Calibration], seen: Sequence[Sequence[tuple[FloatImage, Mask]]], gains: Float64, v: int
) -> Float64 | None:
    """(3, 3) from a view's colours, with its gain, to the first one's; None where they do not overlap."""
    normal, mixed = np.zeros((3, 3)), np.zeros((3, 3))
    count = 0
    for n, (first, own) in enumerate(zip(seen[0], seen[v], strict=True)):
        both = first[1] & own[1]
        count += int(both.sum())
        mixings = [calibrations[view].projectors[n].radiometry.mixing for view in (0, v)]
        for colour in range(3):
            wanted = first[0][both] * mixings[0][:, colour]
            light = own[0][both] * gains[v] * mixings[1][:, colour]
            # places count alike, however bright
            scale = 1 / np.maximum(first[0][both].sum(axis=1, keepdims=True), 1e-30)
            normal += (light * scale).T @ (light * scale)
            mixed += (wanted * scale).T @ (light * scale)
    if count < FEWEST_SHARED or np.linalg.cond(normal) > 1e8:
        return None
    return np.asarray(np.linalg.solve(normal, mixed.T).T)
