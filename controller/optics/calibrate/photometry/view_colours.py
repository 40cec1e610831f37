"""Colour differences between views, measured where they overlap.

A projector pixel lights one place of the surface, so two views that see it see the same light of it. Gains are medians
over such pixels, because highlights differ from view to view, and all pairs of views decide them together.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
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


def view_gains(calibrations: Sequence[Calibration]) -> list[FloatImage]:
    """By what each view's channels are multiplied, (3,) each, so that all are in the first one's units.

    The views' projectors are the same, in the same order.
    """
    seen = [[_seen(part) for part in own.projectors] for own in calibrations]
    rows, right = [np.eye(len(seen))[0]], [np.zeros(3)]
    for one, other in combinations(range(len(seen)), 2):
        pairs = [(a[valid & also], b[valid & also])
                 for (a, valid), (b, also) in zip(seen[one], seen[other], strict=True)]  # fmt: skip
        light, there = (np.concatenate([pair[k] for pair in pairs]).astype(np.float64) for k in (0, 1))
        enough = len(light) >= FEWEST_SHARED
        difference = np.median(np.log(there / light), axis=0) if enough else _brighter(seen[other], seen[one])
        weight = len(light) ** 0.5 if enough else UNMEASURED
        rows.append(weight * (np.eye(len(seen))[one] - np.eye(len(seen))[other]))
        right.append(weight * difference)
    logs = np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0]
    return list(np.exp(logs).astype(np.float32))


def in_common_units(calibration: Calibration, gain: FloatImage, folder: Path) -> Calibration:
    """The same calibration with each channel of light multiplied; large images are in nameless files of ``folder``."""

    def scaled(image: FloatImage) -> FloatImage:
        product = array_in_file(folder, image.shape)
        np.multiply(image, gain, out=product)
        return product

    parts = tuple(
        dataclasses.replace(
            part, white=scaled(part.white), indirect=None if part.indirect is None else scaled(part.indirect)
        )
        for part in calibration.projectors
    )
    return dataclasses.replace(calibration, projectors=parts, black=calibration.black * gain)


def _seen(part: ProjectorCalibration) -> tuple[FloatImage, Mask]:
    """(pixels, 3) light of a projector's white where each of its pixels lands, and (pixels,) where that is known."""
    metapixels = part.metapixels
    x, y = np.moveaxis(np.where(metapixels.valid[..., None], metapixels.centre_px, -1).astype(np.float32), 2, 0)
    # the mean of a few pixels: a colour's own samples are two apart
    light = np.asarray(cv2.remap(cv2.blur(part.white, (3, 3)), x, y, cv2.INTER_LINEAR), np.float32).reshape(-1, 3)
    brightest = np.percentile(part.white[::4, ::4].max(axis=2), 99.9)
    return light, metapixels.valid.ravel() & (channels.smallest(light) > FAINTEST * brightest)


def _brighter(one: Sequence[tuple[FloatImage, Mask]], other: Sequence[tuple[FloatImage, Mask]]) -> Float64:
    """(3,): logarithm of a view's mean light over another one's; 0 where one has none."""
    means = [np.concatenate([light[valid] for light, valid in view]).sum(axis=0, dtype=np.float64) /
             max(sum(int(valid.sum()) for _, valid in view), 1) for view in (one, other)]  # fmt: skip
    return np.log(means[0] / means[1]) if min(mean.min() for mean in means) > 0 else np.zeros(3)
