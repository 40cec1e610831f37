"""Fig. 12: the finest sinusoid that one and that all projectors can make, and which part of it the base has to hold."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from controller.config.writer import toml_text
from controller.core.arrays import ByteImage, Float64, FloatImage, Mask
from controller.core.storage import write_atomically
from controller.optics.plan.figures import FAINT, KEPT, MEAN, last_kept
from controller.optics.solve.appearance import scale_frames, solve_base
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.solve.result.metrics import visible_object
from controller.optics.transport import build_transport
from controller.stage.report.pictures import crop_around
from lab.study.experiments.frequency.planned import blurs, predicted
from lab.study.experiments.frequency.waves import AGREES, COUNTS, Stripes, Waves, kept_contrast, make_waves, stripes
from lab.study.experiments.placement.experiment import STANDS, planned_object
from lab.study.experiments.residual import brightest_first
from lab.study.output.drawing import LabelledPicture, Line, plotted, screen, strip
from lab.study.subject.subject import ReachableTarget, Subject
from lab.study.subject.trial import live_frames
from lab.study.values import Cell, Criterion, Experiment, Figure, Result, ResultTable

BOLD = 0.25
"""Amplitude of waves whose sharpening needs more light than there is; ``FAINT`` ones show the resolution alone."""
PREDICTED = 0.1
BY_STRIPES, BY_CONTRAST = "stripes", "contrast"
PLANNED = "as the plan calculates it, within 10 %"
ASKED = 1.4
"""Times as fine as one projector, whatever the optics are."""
LENS_PX = 0.2
"""Blur of a lens in focus on the sharp stage, the least for which a plan was tried."""


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
    shown = {name: stripes(picture, wanted, waves) for name, picture in pictures.items()}
    right = {name: one.limit(waves.frequency) for name, one in shown.items()}
    blur = blurs(subject)
    by_contrast = _criteria(limit, len(every), predicted(subject, wanted, waves, order))
    return Result(
        (*_of_stripes(right, len(every)), *by_contrast),
        (_ratio_table(limit, right, len(every), blur), _limits(subject, wanted, waves, limit), _blur_table(blur),
         _table(waves, contrast), _stripes_table(waves, shown, right)),
        (*_figures(subject, wanted, waves, pictures, contrast, limit), *_stripes_figures(subject, waves, shown, right)),
    )  # fmt: skip


HIGH, LOWER = "base high-passed at F_1, times scale", "base high-passed at F_1 / 4, times scale"
NARROWER, LOW = "base high-passed at F_1, narrower means", "base low-passed at F_1, times scale"


def _by(count: int, amplitude: float) -> str:
    return f"{count} projector{'s' * (count > 1)}, contrast {amplitude / MEAN:.0%}"


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


def _blur_table(blur: dict[str, float]) -> ResultTable:
    rows = tuple(blur.items())
    return ResultTable("blur", "Blur of the optics, measured by the calibration", ("projector", "blur (px)"), rows)


def _compared(subject: Subject, wanted: ReachableTarget, waves: Waves) -> float:
    """Share of the visible object's pixels in which waves are measured."""
    measured = (waves.band >= 0) & wanted.mask
    return float(measured.sum()) / max(int(visible_object(subject.mask).sum()), 1)


def _ratios(limit: dict[str, float], count: int) -> dict[float, tuple[float, float]]:
    """F of one and of all projectors, in cycles a camera pixel, by the wave's contrast."""
    return {amplitude / MEAN: (limit[_by(1, amplitude)], limit[_by(count, amplitude)]) for amplitude in (FAINT, BOLD)}


def _ratio_table(limit: dict[str, float], right: dict[str, float], count: int, blur: dict[str, float]) -> ResultTable:
    mean = float(np.mean(list(blur.values()))) if blur else None
    rows = tuple(
        (judged, f"{contrast:.0%}", every / first, mean)
        for judged, by in ((BY_STRIPES, right), (BY_CONTRAST, limit))
        for contrast, (first, every) in _ratios(by, count).items()
    )
    columns = ("judged by", "contrast of the wave", f"F_{count} / F_1", "blur of the optics, mean (px)")
    return ResultTable("ratio", "How much finer superimposed projectors are", columns, rows)


def _finer(by: dict[str, float], count: int, judged: str) -> Criterion:
    ratios = {contrast: every / first for contrast, (first, every) in _ratios(by, count).items()}
    reached = ", ".join(f"{ratio:.2f} at {contrast:.0%} contrast" for contrast, ratio in ratios.items())
    return Criterion(f"F_{count} / F_1 at least {ASKED}, by {judged}", reached, min(ratios.values()) >= ASKED)


def _criteria(limit: dict[str, float], count: int, planned: tuple[float, float]) -> tuple[Criterion, ...]:
    first, every = limit[_by(1, FAINT)], limit[_by(count, FAINT)]
    as_planned = tuple(
        Criterion(f"{name} {PLANNED}", f"{planned_px / found:.2f} of it", abs(planned_px / found - 1) <= PREDICTED)
        for name, planned_px, found in (("F_1", planned[0], first), (f"F_{count}", planned[1], every))
    )
    return (_finer(limit, count, BY_CONTRAST), *as_planned)


def _of_stripes(right: dict[str, float], count: int) -> tuple[Criterion, ...]:
    """By thresholded photographs: contrast that the scale loses by construction (eqs 5 and 6) does not count."""
    first, every = right[_by(1, FAINT)], right[_by(count, FAINT)]
    keeps = f"keeps F_{count}, within 10 %, by stripes"
    rows = (
        (f"a base high-passed at F_1 {keeps}", right[HIGH] >= 0.9 * every, f"{right[HIGH] / every:.2f} of it"),
        (f"a base high-passed at F_1 / 4 {keeps}", right[LOWER] >= 0.9 * every, f"{right[LOWER] / every:.2f} of it"),
        ("a base low-passed at F_1 falls to F_1, within 15 %, by stripes", right[LOW] <= 1.15 * first,
         f"{right[LOW] / first:.2f} of it"),
    )  # fmt: skip
    bases = tuple(Criterion(asked, reached, holds) for asked, holds, reached in rows)
    return (_finer(right, count, BY_STRIPES), *bases)


def _stripes_table(waves: Waves, shown: dict[str, Stripes], right: dict[str, float]) -> ResultTable:
    rows = tuple(
        (name, float(f * waves.pitch_px), float(one.agree[k]), float(one.count[k]), right[name] * waves.pitch_px)
        for name, one in shown.items()
        for k, f in enumerate(waves.frequency)
        if np.isfinite(one.agree[k])
    )
    title = (
        f"Stripes of photographs, thresholded at their local mean: right where {AGREES:.0%} of the pixels agree with "
        f"the target's, and their number within {COUNTS:.0%}"
    )
    columns = ("way", "cycles a projector pixel", "pixels that agree", "stripes, of the target's", "right up to")
    return ResultTable("stripes", title, columns, rows)


def _stripes_figures(
    subject: Subject, waves: Waves, shown: dict[str, Stripes], right: dict[str, float]
) -> tuple[Figure, ...]:
    whole = crop_around(subject.mask)
    faint = [name for name in shown if name not in (_by(1, BOLD), NARROWER, LOWER)]
    panels = [
        LabelledPicture(
            name, np.repeat(np.uint8(255) * shown[name].picture[whole.rows, whole.columns, None], 3, axis=2)
        )
        for name in faint
    ]
    lines = [Line(f"{name}: {right[name] * waves.pitch_px:.2f}", waves.frequency * waves.pitch_px, shown[name].agree)
             for name in faint]  # fmt: skip
    agreement = plotted(
        lines, x="cycles per pixel of one projector", y="share of pixels that agree",
        marks={"right": ("y", AGREES), "one projector's pixels end": ("x", 0.5)}, y_range=(0.4, 1.05),
    )  # fmt: skip
    return (
        Figure("agreement", "Share of the thresholded photograph's pixels that agree with the target's.", agreement),
        Figure("stripes", "The photographs, thresholded at their local mean.", strip(panels, columns=3)),
    )


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
    shows="F_3 / F_1 >= 1.4; F_1 and F_3 are as planned; a base high-passed keeps F_3, one low-passed falls to F_1.",
    scene="curved",
    run=rising_sinusoid,
    cost_s=60.0,
)
FREQUENCY_SHARP = Experiment(
    name="frequency-sharp",
    title="The finest sinusoid with sharp optics",
    paper="Paper 3.3, 6, Fig. 12, continued",
    shows="the same, on optics that blur by at most 0.35 px.",
    scene="sharp",
    run=rising_sinusoid,
    cost_s=60.0,
)
