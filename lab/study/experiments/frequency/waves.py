"""Waves on the object, one frequency a band of rows, and how much of their contrast a photograph keeps."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from controller.core.arrays import Float64, FloatImage, Mask
from controller.optics.plan.figures import FAINT, MEAN, last_kept
from controller.optics.solve.targets.values import Target, through_camera
from controller.stage.report.pictures import crop_around
from lab.study.subject.subject import ReachableTarget, Subject

BANDS = 18
LOWEST, HIGHEST = 0.15, 1.25
"""Frequencies, in cycles a pixel of one projector as the camera sees it; one projector's pixels end at 0.5."""
MIDDLE = 0.6
"""Of the object's width: farther out the surface turns away, its pixels are narrower and would blur the figure."""
GREEN = 1
AGREES, COUNTS = 0.8, 0.1
"""Stripes are right where this share of pixels agrees with the target's, and their number does within this part."""


@dataclass(frozen=True, slots=True)
class Waves:
    """The target and where its waves are: one frequency a band of rows, rising downwards.

    ``frequency`` (bands,) cycles a camera pixel; ``band`` (rows, columns) its number, -1 where nothing is measured;
    ``phase`` (rows, columns) radians; ``pitch_px`` camera pixels a projector pixel
    """

    target: Target
    frequency: Float64
    band: np.ndarray[tuple[int, ...], np.dtype[np.int64]]
    phase: Float64
    pitch_px: float


def make_waves(subject: Subject, n: int, *, amplitude: float = FAINT) -> Waves:
    """Bands of upright waves over the object's middle, their frequency in pixels of projector ``n``."""
    mask = subject.mask
    box = crop_around(mask, margin=0.0)
    pitch = _pitch_px(subject, n, box)
    frequency = np.linspace(LOWEST, HIGHEST, BANDS) / pitch
    rows, columns = np.arange(mask.shape[0]), np.arange(mask.shape[1])
    height = (box.rows.stop - box.rows.start) / BANDS
    number = np.clip(((rows - box.rows.start) / height).astype(np.int64), 0, BANDS - 1)
    middle = 0.5 * (box.columns.start + box.columns.stop)
    phase = 2 * np.pi * frequency[number][:, None] * (columns - middle)
    image = np.where(mask[..., None], (MEAN + amplitude * np.cos(phase))[..., None], 0).astype(np.float32)
    image = np.repeat(image, 3, axis=2)
    # The rim of a band has its neighbour's waves in its blur.
    inner = np.abs((rows - box.rows.start) / height - number - 0.5) < 0.35
    near = np.abs(columns - middle) < 0.5 * MIDDLE * (box.columns.stop - box.columns.start)
    band = np.where(mask & inner[:, None] & near, number[:, None], -1)
    return Waves(through_camera(Target(image, mask)), frequency, band, np.asarray(phase), pitch)


def _pitch_px(subject: Subject, n: int, box: object) -> float:
    """Camera pixels along a row that a pixel of projector ``n`` takes, median over the object's middle."""
    metapixels = subject.calibration.projectors[n].metapixels
    centre = np.where(metapixels.valid[..., None], metapixels.centre_px, np.nan).astype(np.float64)
    across = np.diff(centre, axis=1)[..., 0]
    known = np.isfinite(across)
    middle = np.nanmedian(centre[..., 0])
    span = np.nanpercentile(centre[..., 0], 97) - np.nanpercentile(centre[..., 0], 3)
    known &= np.abs(centre[:, 1:, 0] - middle) < 0.5 * MIDDLE * span
    return float(np.median(np.abs(across[known])))


def kept_contrast(picture: FloatImage, wanted: ReachableTarget, waves: Waves) -> Float64:
    """(bands,): the wave's amplitude in phase with the target's, over the target's, in the green channel."""
    kept = np.full(waves.frequency.size, np.nan)
    for number in range(waves.frequency.size):
        inside = (waves.band == number) & wanted.mask
        if inside.sum() < 200:
            continue
        ours, theirs = (_amplitude(image[..., GREEN][inside], waves, inside) for image in (picture, wanted.radiance))
        kept[number] = ours / theirs
    return kept


def _amplitude(values: FloatImage, waves: Waves, inside: Mask) -> float:
    """Least squares of cosine, sine and a slow change; what is not in phase counts as lost."""
    phase = waves.phase[inside]
    x = np.nonzero(inside)[1].astype(np.float64)
    x = (x - x.mean()) / max(float(np.ptp(x)), 1.0)
    parts = np.stack([np.cos(phase), np.sin(phase), np.ones_like(x), x, x * x, x**3], axis=1)
    return float(np.linalg.lstsq(parts, values.astype(np.float64), rcond=None)[0][0])


@dataclass(frozen=True, slots=True)
class Stripes:
    """A photograph beside its target, both black and white after a threshold at their local mean, by band.

    ``agree`` (bands,) share of pixels that agree: by chance a half; ``count`` (bands,) edges of stripes, of whole
    columns, over the target's; NaN where too little is seen. Of what is thresholded (rows, columns): ``picture``
    """

    agree: Float64
    count: Float64
    picture: Mask

    def limit(self, frequency: Float64) -> float:
        """Up to which of the bands' frequencies stripes are right; beyond it they alias or are lost."""
        is_right = np.abs(self.count - 1) <= COUNTS
        return last_kept(frequency, np.where(np.isnan(self.count) | is_right, self.agree, 0.0), share=AGREES)


def stripes(picture: FloatImage, wanted: ReachableTarget, waves: Waves) -> Stripes:
    """What a thresholded photograph shows, as the paper's figure does: right stripes need no contrast."""
    seen = waves.band >= 0
    ours, theirs = (_above_mean(image[..., GREEN], wanted.mask, waves) for image in (picture, wanted.radiance))
    agree, count = (np.full(waves.frequency.size, np.nan) for _ in range(2))
    for number in range(waves.frequency.size):
        inside = (waves.band == number) & wanted.mask
        if inside.sum() < 200:
            continue
        agree[number] = np.mean(ours[inside] == theirs[inside])
        edges, expected = (_edges(one, inside) for one in (ours, theirs))
        count[number] = edges / max(expected, 1)
    return Stripes(agree, count, np.asarray(ours & seen))


def _edges(above: Mask, inside: Mask) -> int:
    """Edges of upright stripes: each column is white or black as most of its pixels are, so that noise is no stripe."""
    seen = inside.any(axis=0)
    white = (above & inside).sum(axis=0)[seen] > 0.5 * inside.sum(axis=0)[seen]
    return int(np.count_nonzero(white[1:] != white[:-1]))


def _above_mean(values: FloatImage, mask: Mask, waves: Waves) -> Mask:
    """Where an image (rows, columns) is above its mean along the row, over a wavelength of the lowest frequency."""
    size = (2 * round(0.5 / float(waves.frequency[0])) + 1, 1)
    weight = cv2.blur(mask.astype(np.float64), size)
    total = cv2.blur(np.where(mask, values, 0).astype(np.float64), size)
    return np.asarray(values > total / np.maximum(weight, 1e-9))
