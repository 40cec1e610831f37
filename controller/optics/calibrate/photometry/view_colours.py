"""Colour differences between views, measured where they overlap.

A projector pixel lights one place of the surface, so two views that see it see the same light of it. Gains are medians
over such pixels, because highlights differ from view to view, and all pairs of views decide them together.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from itertools import combinations, permutations
from pathlib import Path
from typing import Final, TypeAlias

import cv2
import numpy as np

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, Mask, array_in_file
from controller.optics.calibrate.values import Calibration, ProjectorCalibration

FAINTEST: Final = 0.02
"""Of a projector's white: darker places are not compared."""
FEWEST_SHARED: Final = 100
"""Projector pixels that tell how two views differ."""
LAMP_CHANGED: Final = 0.03
"""Smaller changes of one projector's light compared with the others' are as likely gloss."""
UNMEASURED: Final = 1e-3
"""Weight of views' mean light, which decides for views that overlap no other one."""


_View: TypeAlias = tuple[FloatImage, Mask]
_Views: TypeAlias = Sequence[Sequence[_View]]
"""What ``_seen`` gives, of each view and projector."""


def view_gains(calibrations: Sequence[Calibration], newest: int | None = None) -> tuple[list[FloatImage], FloatImage]:
    """By what each view's channels are multiplied, (3,) each, so that all are in the first one's units; and each of its
    projectors' light before, (views, projectors), up to 1.

    The views' projectors are the same, in the same order. ``newest``: the view whose lamps are those of now; None where
    all views were photographed with the same light
    """
    seen = [[_seen(part) for part in own.projectors] for own in calibrations]
    lamps = np.ones((len(seen), len(seen[0])), np.float32) if newest is None else _lamps(seen, newest)
    seen = [[(light * lamp, valid) for (light, valid), lamp in zip(*own, strict=True)]
            for own in zip(seen, lamps, strict=True)]  # fmt: skip
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
    return list(np.exp(logs).astype(np.float32)), lamps


def _lamps(seen: _Views, newest: int) -> FloatImage:
    """(views, projectors): the lamps of the view ``newest`` over those of each view, where the least weakened has 1."""
    changed = np.full((len(seen), len(seen[0])), np.nan)
    changed[newest] = 0
    for n, of in enumerate(changed.T):
        # from the newest view to those that overlap it, and on from these
        while True:
            known = np.isfinite(of)
            pairs = [(one, other) for one, other in permutations(range(len(of)), 2) if known[one] and not known[other]]
            ratios = ((one, other, _ratio(seen[one][n], seen[other][n])) for one, other in pairs)
            linked = next(((one, other, ratio) for one, other, ratio in ratios if ratio is not None), None)
            if linked is None:
                break
            one, other, ratio = linked
            of[other] = of[one] + ratio
    changed -= np.fmax.reduce(changed, axis=1, keepdims=True)
    lamps: FloatImage = np.exp(np.nan_to_num(changed)).astype(np.float32)
    lamps[lamps.min(axis=1) > 1 - LAMP_CHANGED] = 1
    return lamps


def _ratio(one: _View, other: _View) -> float | None:
    """Logarithm of a projector's light in one view over that in another one; None where they share too little."""
    both = one[1] & other[1]
    if np.count_nonzero(both) < FEWEST_SHARED:
        return None
    return float(np.median(np.log(channels.mean(one[0])[both] / channels.mean(other[0])[both])))


def in_common_units(calibration: Calibration, gain: FloatImage, lamps: FloatImage, folder: Path) -> Calibration:
    """The same calibration with each channel of light multiplied by ``gain`` (3,), and each projector's by ``lamps``
    (projectors,), too; large images are in nameless files of ``folder``.
    """

    def scaled(image: FloatImage, lamp: np.float32) -> FloatImage:
        product = array_in_file(folder, image.shape)
        np.multiply(image, gain * lamp, out=product)
        return product

    parts = tuple(
        dataclasses.replace(
            part,
            white=scaled(part.white, lamp),
            indirect=None if part.indirect is None else scaled(part.indirect, lamp),
        )
        for part, lamp in zip(calibration.projectors, lamps, strict=True)
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
