"""Fig. 12: the finest sinusoid that one and that all projectors can make, and which part of it the base has to hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from controller.arrays import Float64, FloatImage, Mask
from controller.report.pictures import crop_around
from controller.solve.appearance import scale_frames, solve_base
from controller.solve.bounded import solve_bounded
from controller.solve.targets import Target, through_camera
from controller.study.drawing import Line, Panel, plotted, screen, strip
from controller.study.residual import brightest_first
from controller.study.subject import Subject, Wanted
from controller.study.values import Cell, Criterion, Experiment, Figure, Result, Table
from controller.transport import LightTransport

BANDS = 18
LOWEST, HIGHEST = 0.15, 1.25
"""Frequencies, in cycles a pixel of one projector as the camera sees it; one projector's pixels end at 0.5."""
MEAN, AMPLITUDE = 0.5, 0.25
KEPT = 0.5
"""F is the frequency up to which the photograph keeps this part of the target's contrast."""
ASKED = 1.5
MIDDLE = 0.6
"""Of the object's width: where it turns away, its pixels are narrower and would blur the figure."""
GREEN = 1


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


def rising_sinusoid(subject: Subject) -> Result:
    """Make the waves with one and with all projectors, then by base times scale with two kinds of base."""
    order = brightest_first(subject)
    every, black = list(range(len(order))), subject.calibration.black
    waves = make_waves(subject, order[0])
    alone = LightTransport.build(subject.with_projectors(order[:1]))
    wanted = subject.wanted(waves.target, transport=alone)
    pictures: dict[str, FloatImage] = {}
    for number, which in enumerate((order[:1], every)):
        subject.advance(0.2 * number, f"{len(which)} projectors")
        transport = alone if len(which) == 1 else subject.transport
        frames = subject.frames_of(which, solve_bounded(transport, wanted.radiance, black).frames)
        pictures[_by(len(which))] = subject.light.photograph(f"{len(which)}", frames, white=wanted.white)
    contrast = {name: kept_contrast(picture, wanted, waves) for name, picture in pictures.items()}
    limit = {name: last_kept(waves.frequency, kept) for name, kept in contrast.items()}
    first = limit[_by(1)]
    for number, (name, base) in enumerate(bases(wanted, black, subject.mask, first).items()):
        subject.advance(0.4 + 0.3 * number, name)
        solved = solve_base(subject.transport, base, black)
        frames = scale_frames(subject.transport, solved, wanted.radiance, black)
        pictures[name] = subject.light.photograph(f"base-{number}", frames, white=wanted.white)
        contrast[name] = kept_contrast(pictures[name], wanted, waves)
        limit[name] = last_kept(waves.frequency, contrast[name])
    return Result(
        _criteria(limit, len(every)), (_table(waves, contrast), _limits(waves, limit)),
        _figures(subject, wanted, waves, pictures, contrast, limit), TEXT,
    )  # fmt: skip


HIGH, LOW = "base high-passed at F_1, times scale", "base low-passed at F_1, times scale"


def _by(count: int) -> str:
    return f"{count} projector{'s' * (count > 1)}"


def make_waves(subject: Subject, n: int) -> Waves:
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
    image = np.where(mask[..., None], (MEAN + AMPLITUDE * np.cos(phase))[..., None], 0).astype(np.float32)
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


def kept_contrast(picture: FloatImage, wanted: Wanted, waves: Waves) -> Float64:
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


def last_kept(frequency: Float64, kept: Float64, *, share: float = KEPT) -> float:
    """The first frequency at which the contrast falls below ``share``, between bands by a straight line."""
    known = np.isfinite(kept)
    frequency, kept = frequency[known], kept[known]
    below = np.flatnonzero(kept < share)
    if not below.size:
        return float(frequency[-1])
    i = int(below[0])
    if i == 0:
        return float(frequency[0])
    part = (kept[i - 1] - share) / (kept[i - 1] - kept[i])
    return float(frequency[i - 1] + part * (frequency[i] - frequency[i - 1]))


def bases(wanted: Wanted, black: FloatImage, mask: Mask, limit: float) -> dict[str, FloatImage]:
    """Base images for the target: even with its detail above ``limit`` (cycles a camera pixel), and only what is below.

    The filter is a Gaussian that halves the amplitude at ``limit``, over the object alone.
    """
    sigma = float(np.sqrt(2 * np.log(2))) / (2 * np.pi * limit)
    light = np.maximum(wanted.radiance - black, 0)
    weight = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), sigma)
    blurred = cv2.GaussianBlur(np.where(mask[..., None], light, 0).astype(np.float32), (0, 0), sigma)
    low = np.where(mask[..., None], blurred / np.maximum(weight, 1e-6)[..., None], 0).astype(np.float32)
    even = np.float32(MEAN * wanted.white)
    detail = np.divide(light, low, out=np.zeros_like(light), where=low > 0)
    return {HIGH: np.asarray(black + even * detail, np.float32), LOW: np.asarray(black + low, np.float32)}


def _criteria(limit: dict[str, float], count: int) -> tuple[Criterion, ...]:
    first, every, high, low = (limit[name] for name in (_by(1), _by(count), HIGH, LOW))
    return (
        Criterion(
            f"F_{count} / F_1 at least {ASKED}", f"{every / first:.2f}", every / first >= ASKED,
            REASON if every / first < ASKED else "",
        ),
        Criterion(
            f"a base high-passed at F_1 keeps F_{count}, within 10 %", f"{high / every:.2f} of it", high >= 0.9 * every,
            "" if high >= 0.9 * every else HIGH_REASON,
        ),
        Criterion(
            "a base low-passed at F_1 falls to F_1, within 15 %", f"{low / first:.2f} of it", low <= 1.15 * first,
            "" if low <= 1.15 * first else LOW_REASON,
        ),
    )  # fmt: skip


def _table(waves: Waves, contrast: dict[str, Float64]) -> Table:
    columns = ("cycles a projector pixel", "cycles a camera pixel", *contrast)
    rows: list[tuple[Cell, ...]] = [
        (float(f * waves.pitch_px), float(f), *(float(kept[k]) for kept in contrast.values()))
        for k, f in enumerate(waves.frequency)
    ]
    return Table("contrast", "Contrast kept, of the target's", columns, tuple(rows))


def _limits(waves: Waves, limit: dict[str, float]) -> Table:
    rows = tuple((name, f * waves.pitch_px, f) for name, f in limit.items())
    return Table(
        "limits",
        "F: where half of the contrast is left",
        ("way", "cycles a projector pixel", "cycles a camera pixel"),
        rows,
    )


def _figures(
    subject: Subject,
    wanted: Wanted,
    waves: Waves,
    pictures: dict[str, FloatImage],
    contrast: dict[str, Float64],
    limit: dict[str, float],
) -> tuple[Figure, ...]:
    whole = crop_around(subject.mask)
    matrix = subject.calibration.camera_to_xyz
    named: Sequence[tuple[str, FloatImage]] = [("target", wanted.radiance), *pictures.items()]
    panels = [Panel(name, screen(image, matrix, wanted.white, whole)) for name, image in named]
    lines = [Line(f"{name}: F = {limit[name] * waves.pitch_px:.2f}", waves.frequency * waves.pitch_px, kept)
             for name, kept in contrast.items()]  # fmt: skip
    return (
        Figure(
            "curves",
            "Contrast that the photograph keeps of the target's, by frequency; F is where it falls below a half.",
            plotted(
                lines, x="cycles per pixel of one projector", y="contrast kept",
                marks={"half": ("y", KEPT), "one projector's pixels end": ("x", 0.5)}, y_range=(-0.1, 1.15),
            ),
        ),
        Figure("photographs", "The target, frequency rising downwards, and the photographs.", strip(panels, columns=3)),
    )  # fmt: skip


REASON = HIGH_REASON = LOW_REASON = ""

TEXT = f"""\
Bands of upright waves, {AMPLITUDE / MEAN:.0%} contrast around a grey, their frequency rising from {LOWEST} to
{HIGHEST} cycles a projector pixel, over the middle {MIDDLE:.0%} of a pale shell, at an exposure that one projector
can reach. *Contrast kept* is the amplitude in phase with the target's wave, in the photograph's green channel, over
the target's own as the camera sees it; what comes out at another phase or frequency counts as lost. F is where it
falls below {KEPT:.0%}. The bases hold the target's detail above F_1, or only what is below it, and are multiplied
with the scale that remains (eqs 4-6)."""

FREQUENCY = Experiment(
    name="frequency",
    title="The finest sinusoid",
    paper="Paper 3.3, 6, Fig. 12",
    shows="F_3 / F_1 >= 1.5; a base high-passed keeps F_3, one low-passed falls to F_1.",
    scene="curved",
    run=rising_sinusoid,
    cost_s=60.0,
)
