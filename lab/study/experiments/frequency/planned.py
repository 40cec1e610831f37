"""The finest waves as ``velatura plan`` calculates them, from the blur, the pitch and the light that were measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from controller.core.arrays import Float64, FloatImage, Mask
from controller.optics.plan.figures import KEPT, LineProjector, kept_contrast, last_kept
from controller.optics.plan.optics import PIXEL_VARIANCE_PX2
from lab.study.experiments.frequency.waves import GREEN, Waves
from lab.study.subject.subject import ReachableTarget, Subject

PLACES = 40
"""Of a band, at which the plan's contrast is calculated."""


def blurs(subject: Subject) -> dict[str, float]:
    """Median blur of each projector's optics, standard deviation in its pixels, without the pixel's own square."""
    found = {}
    for part in subject.calibration.projectors:
        if part.phase_map is not None:
            spread = part.phase_map.spread_px2[..., (0, 2)].mean(axis=-1)
            found[part.name] = float(np.sqrt(max(float(np.nanmedian(spread[spread > 0])) - PIXEL_VARIANCE_PX2, 0.0)))
    return found


def predicted(subject: Subject, wanted: ReachableTarget, waves: Waves, order: Sequence[int]) -> tuple[float, float]:
    """F_1 and F of all in cycles a camera pixel, as ``velatura plan`` calculates them, from blur, pitch and light.

    At ``PLACES`` of each band, because they differ over the object. A median would be of a place that is sharper than
    half of them, and the sharp half can't make up for the blurred one.
    """
    light = [_full_light(subject, n) / wanted.white for n in order]
    along = [_AlongRows.of(subject, n) for n in order]
    first, every = (np.full(waves.frequency.size, np.nan) for _ in range(2))
    for band, frequency in enumerate(waves.frequency * waves.pitch_px):
        rows, columns = np.nonzero((waves.band == band) & wanted.mask & along[0].known)
        if rows.size < PLACES:
            continue
        some = ((np.arange(PLACES) + 0.5) / PLACES * rows.size).astype(np.int64)
        lines = [
            [
                LineProjector(one.pitch_px[at] / waves.pitch_px, one.blur_px[at], lit[at])
                for one, lit in zip(along, light, strict=True)
                if one.known[at]
            ]
            for at in zip(rows[some], columns[some], strict=True)
        ]
        first[band], every[band] = (
            _mean_contrast([line[:1] for line in lines], frequency),
            _mean_contrast(lines, frequency),
        )
        if max(first[band], every[band]) < KEPT:
            break
    return last_kept(waves.frequency, first), last_kept(waves.frequency, every)


def _mean_contrast(lines: Sequence[Sequence[LineProjector]], frequency: float) -> float:
    asked = np.array([frequency])
    return float(np.mean([kept_contrast(line, asked, draws=1, seed=seed) for seed, line in enumerate(lines)]))


def _full_light(subject: Subject, n: int) -> FloatImage:
    """(camera rows, columns): green light of projector ``n`` alone at full white."""
    full = np.ones((*subject.calibration.projectors[n].metapixels.valid.shape, 3), np.float32)
    return np.asarray(subject.transport.forward(subject.frames_of([n], [full]))[..., GREEN])


@dataclass(frozen=True, slots=True)
class _AlongRows:
    """A projector's pixels as each camera pixel sees them along its row: (camera rows, columns).

    ``pitch_px`` in camera pixels; ``blur_px``: standard deviation in projector pixels without their square, the
    camera's blur and its interpolation included
    """

    pitch_px: Float64
    blur_px: Float64
    known: Mask

    @classmethod
    def of(cls, subject: Subject, n: int) -> Self:
        part = subject.calibration.projectors[n]
        assert part.phase_map is not None
        pixels = part.metapixels
        centre = np.where(pixels.valid, pixels.centre_px[..., 0], np.nan).astype(np.float64)
        pitch = np.abs(np.gradient(centre, axis=1))
        spread = pixels.covariance_px2[..., 0] / pitch**2
        at = np.nan_to_num(np.rint(part.phase_map.projector_px), nan=-1.0).astype(np.int64)
        x, y = (np.clip(at[..., k], 0, size - 1) for k, size in ((0, pitch.shape[1]), (1, pitch.shape[0])))
        known = np.isfinite(part.phase_map.projector_px).all(axis=2) & np.isfinite(spread[y, x])
        blur = np.sqrt(np.maximum(np.nan_to_num(spread) - PIXEL_VARIANCE_PX2, 0.0))
        return cls(pitch[y, x], blur[y, x], np.asarray(known))
