"""Fig. 12: the finest sinusoid that one and that all projectors can make, and which part of it the base has to hold."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import cv2
import numpy as np

from controller.config.writer import toml_text
from controller.core.arrays import ByteImage, Float64, FloatImage, Mask
from controller.core.storage import write_atomically
from controller.plan.optics import PIXEL_VARIANCE_PX2
from controller.plan.resolution import FAINT, KEPT, MEAN, LineProjector, last_kept
from controller.plan.resolution import kept_contrast as line_contrast
from controller.report.pictures import crop_around
from controller.solve.appearance import scale_frames, solve_base
from controller.solve.bounded.solver import solve_bounded
from controller.solve.judged import visible_object
from controller.solve.targets.values import Target, through_camera
from controller.study.experiments.placement.experiment import STANDS, planned_object
from controller.study.experiments.residual import brightest_first
from controller.study.lab.subject import ReachableTarget, Subject
from controller.study.lab.trial import live_frames
from controller.study.output.drawing import LabelledPicture, Line, plotted, screen, strip
from controller.study.values import Cell, Criterion, Experiment, Figure, Result, ResultTable
from controller.transport import build_transport

BANDS = 18
LOWEST, HIGHEST = 0.15, 1.25
"""Frequencies, in cycles a pixel of one projector as the camera sees it; one projector's pixels end at 0.5."""
BOLD = 0.25
"""Amplitude of waves whose sharpening needs more light than there is; ``FAINT`` ones show the resolution alone."""
PREDICTED = 0.1
PLACES = 40
"""Of a band, at which the plan's contrast is calculated."""
PLANNED = "as the plan calculates it, within 10 %"
ASKED = 1.4
SHARP_PX = 0.35
"""Blur of the optics, in projector pixels and on average, up to which F_3 / F_1 has to be ``ASKED``."""
LENS_PX = 0.2
"""Blur of a lens in focus on the sharp stage, the least for which a plan was tried."""
MIDDLE = 0.6
"""Of the object's width: farther out the surface turns away, its pixels are narrower and would blur the figure."""
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


def sharp_object(path: Path, seed: int) -> None:
    """As ``planned_object``, with lenses of ``LENS_PX``, and so small a pupil that no depth is out of focus."""
    planned_object(path, seed)
    place = path.parent / STANDS
    stands = tomllib.loads(place.read_text())["stands"]
    write_atomically(
        place, toml_text({"stands": [{**one, "pupil_m": 0.0, "sharpest_px": LENS_PX} for one in stands]}).encode()
    )


def rising_sinusoid(subject: Subject) -> Result:
    """Make waves of two contrasts with one and with all projectors, then the faint ones by base times scale."""
    order = brightest_first(subject)
    every, black = list(range(len(order))), subject.calibration.black
    alone = build_transport(subject.with_projectors(order[:1]))
    pictures: dict[str, FloatImage] = {}
    contrast: dict[str, Float64] = {}
    for number, amplitude in enumerate((BOLD, FAINT)):
        waves = make_waves(subject, order[0], amplitude=amplitude)
        wanted = subject.wanted(waves.target, transport=alone)
        for which in (order[:1], every):
            name = _by(len(which), amplitude)
            subject.advance(0.25 * number + 0.12 * (len(which) > 1), name)
            transport = alone if len(which) == 1 else subject.transport
            frames = subject.frames_of(which, solve_bounded(transport, wanted.direct, black).frames)
            pictures[name] = subject.light.photograph(f"{len(which)}-{number}", frames, white=wanted.white)
            contrast[name] = kept_contrast(pictures[name], wanted, waves)
    first = last_kept(waves.frequency, contrast[_by(1, FAINT)])
    for number, (name, base) in enumerate(bases(wanted, black, subject.mask, first).items()):
        subject.advance(0.5 + 0.16 * number, name)
        solved = solve_base(subject.transport, base, black)
        ways: dict[str, Sequence[FloatImage]] = {name: scale_frames(subject.transport, solved, wanted.direct, black)}
        if name == HIGH:
            ways[NARROWER] = live_frames(subject, solved, wanted.radiance)
        for way, made in ways.items():
            pictures[way] = subject.light.photograph(f"base-{len(pictures)}", made, white=wanted.white)
            contrast[way] = kept_contrast(pictures[way], wanted, waves)
    limit = {name: last_kept(waves.frequency, kept) for name, kept in contrast.items()}
    blur = blurs(subject)
    return Result(
        _criteria(limit, len(every), blur, predicted(subject, wanted, waves, order)),
        (_ratio_table(limit, len(every), blur), _limits(subject, wanted, waves, limit), _blur_table(blur),
         _table(waves, contrast)),
        _figures(subject, wanted, waves, pictures, contrast, limit),
    )  # fmt: skip


HIGH, LOWER = "base high-passed at F_1, times scale", "base high-passed at F_1 / 4, times scale"
NARROWER, LOW = "base high-passed at F_1, narrower means", "base low-passed at F_1, times scale"


def _by(count: int, amplitude: float) -> str:
    return f"{count} projector{'s' * (count > 1)}, contrast {amplitude / MEAN:.0%}"


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


def bases(wanted: ReachableTarget, black: FloatImage, mask: Mask, limit: float) -> dict[str, FloatImage]:
    """Base images for the target: even with its detail above a frequency, or only what is below it.

    ``limit``: F_1 in cycles a camera pixel. The filter is a Gaussian that halves the amplitude there, over the object
    alone.
    """
    light = np.maximum(wanted.radiance - black, 0)
    even = np.float32(MEAN * wanted.white)

    def below(frequency: float) -> FloatImage:
        sigma = float(np.sqrt(2 * np.log(2))) / (2 * np.pi * frequency)
        weight = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), sigma)
        blurred = cv2.GaussianBlur(np.where(mask[..., None], light, 0).astype(np.float32), (0, 0), sigma)
        return np.where(mask[..., None], blurred / np.maximum(weight, 1e-6)[..., None], 0).astype(np.float32)

    def high_passed(frequency: float) -> FloatImage:
        low = below(frequency)
        detail = np.divide(light, low, out=np.zeros_like(light), where=low > 0)
        return np.asarray(black + even * detail, np.float32)

    low_passed = np.asarray(black + below(limit), np.float32)
    return {HIGH: high_passed(limit), LOWER: high_passed(0.25 * limit), LOW: low_passed}


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
    return float(np.mean([line_contrast(line, asked, draws=1, seed=seed) for seed, line in enumerate(lines)]))


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


def _blur_table(blur: dict[str, float]) -> ResultTable:
    rows = tuple(blur.items())
    return ResultTable("blur", "Blur of the optics, measured by the calibration", ("projector", "blur (px)"), rows)


def _compared(subject: Subject, wanted: ReachableTarget, waves: Waves) -> float:
    """Share of the visible object's pixels in which waves are measured."""
    measured = (waves.band >= 0) & wanted.mask
    return float(measured.sum()) / max(int(visible_object(subject.mask).sum()), 1)


def _sharp(blur: dict[str, float]) -> bool:
    return bool(blur) and float(np.mean(list(blur.values()))) <= SHARP_PX


def _ratios(limit: dict[str, float], count: int) -> dict[float, tuple[float, float]]:
    """F of one and of all projectors, in cycles a camera pixel, by the wave's contrast."""
    return {amplitude / MEAN: (limit[_by(1, amplitude)], limit[_by(count, amplitude)]) for amplitude in (FAINT, BOLD)}


def _ratio_table(limit: dict[str, float], count: int, blur: dict[str, float]) -> ResultTable:
    """All stages' ratios, also where none is asked for."""
    mean = float(np.mean(list(blur.values()))) if blur else None
    asked = f"at least {ASKED}" if _sharp(blur) else f"nothing: {SHARP_PX} px are needed for {ASKED}"
    rows = tuple((f"{contrast:.0%}", every / first, mean, asked) for contrast, (first, every) in
                 _ratios(limit, count).items())  # fmt: skip
    return ResultTable("ratio", "How much finer superimposed projectors are",
                       ("contrast of the wave", f"F_{count} / F_1", "blur of the optics, mean (px)", "asked"),
                       rows)  # fmt: skip


def _criteria(
    limit: dict[str, float], count: int, blur: dict[str, float], planned: tuple[float, float]
) -> tuple[Criterion, ...]:
    first, every = limit[_by(1, FAINT)], limit[_by(count, FAINT)]
    high, lower, low = limit[HIGH], limit[LOWER], limit[LOW]
    keeps = f"keeps F_{count}, within 10 %"
    finer = tuple(
        (f"F_{count} / F_1 at least {ASKED}, at {contrast:.0%} contrast", b / a >= ASKED, f"{b / a:.2f}")
        for contrast, (a, b) in _ratios(limit, count).items()
        if _sharp(blur)
    )
    rows = (
        *finer,
        (f"a base high-passed at F_1 {keeps}", high >= 0.9 * every, f"{high / every:.2f} of it"),
        (f"a base high-passed at F_1 / 4 {keeps}", lower >= 0.9 * every, f"{lower / every:.2f} of it"),
        ("a base low-passed at F_1 falls to F_1, within 15 %", low <= 1.15 * first, f"{low / first:.2f} of it"),
    )
    as_planned = tuple(
        (f"{name} {PLANNED}", abs(planned_px / found - 1) <= PREDICTED, f"{planned_px / found:.2f} of it")
        for name, planned_px, found in (("F_1", planned[0], first), (f"F_{count}", planned[1], every))
    )
    return tuple(Criterion(asked, reached, holds) for asked, holds, reached in (*rows, *as_planned))


def _table(waves: Waves, contrast: dict[str, Float64]) -> ResultTable:
    columns = ("cycles a projector pixel", "cycles a camera pixel", *contrast)
    rows: list[tuple[Cell, ...]] = [
        (float(f * waves.pitch_px), float(f), *(float(kept[k]) for kept in contrast.values()))
        for k, f in enumerate(waves.frequency)
    ]
    return ResultTable("contrast", "Contrast kept, of the target's", columns, tuple(rows))


def _limits(subject: Subject, wanted: ReachableTarget, waves: Waves, limit: dict[str, float]) -> ResultTable:
    compared = _compared(subject, wanted, waves)
    rows = tuple((name, f * waves.pitch_px, f, f"{1 - compared:.1%}", wanted.as_asked) for name, f in limit.items())
    return ResultTable(
        "limits",
        "F: where half of the contrast is left",
        ("way", "cycles a projector pixel", "cycles a camera pixel", "left out of the visible object", "target"),
        rows,
    )


def _figures(
    subject: Subject,
    wanted: ReachableTarget,
    waves: Waves,
    pictures: dict[str, FloatImage],
    contrast: dict[str, Float64],
    limit: dict[str, float],
) -> tuple[Figure, ...]:
    whole = crop_around(subject.mask)
    matrix = subject.calibration.camera_to_xyz
    named: Sequence[tuple[str, FloatImage]] = [("target", wanted.radiance), *pictures.items()]
    panels = [LabelledPicture(name, screen(image, matrix, wanted.white, whole)) for name, image in named]
    by_base = (HIGH, NARROWER, LOWER, LOW)
    solved = [name for name in contrast if name not in by_base]

    def curves(names: Sequence[str]) -> ByteImage:
        lines = [Line(f"{name}: F = {limit[name] * waves.pitch_px:.2f}", waves.frequency * waves.pitch_px,
                      contrast[name]) for name in names]  # fmt: skip
        return plotted(
            lines, x="cycles per pixel of one projector", y="contrast kept",
            marks={"half": ("y", KEPT), "one projector's pixels end": ("x", 0.5)}, y_range=(-0.05, 1.1),
        )  # fmt: skip

    return (
        Figure(
            "curves",
            "Contrast that the photograph keeps of the target's, by frequency; F is where it falls below a half.",
            curves(solved),
        ),
        Figure(
            "bases",
            "The same for bases times scale, beside the full solve with all projectors.",
            curves([solved[-1], *by_base]),
        ),
        Figure("photographs", "The target, frequency rising downwards, and the photographs.", strip(panels, columns=3)),
    )  # fmt: skip


FREQUENCY = Experiment(
    name="frequency",
    title="The finest sinusoid",
    paper="Paper 3.3, 6, Fig. 12",
    shows="F_1 and F_3 are as planned; a base high-passed keeps F_3, one low-passed falls to F_1.",
    scene="curved",
    run=rising_sinusoid,
    cost_s=60.0,
)
FREQUENCY_SHARP = Experiment(
    name="frequency-sharp",
    title="The finest sinusoid with sharp optics",
    paper="Paper 3.3, 6, Fig. 12, continued",
    shows="F_3 / F_1 >= 1.4 where the optics blur by at most 0.35 px; F_1 and F_3 are as planned.",
    scene="sharp",
    run=rising_sinusoid,
    cost_s=60.0,
)
