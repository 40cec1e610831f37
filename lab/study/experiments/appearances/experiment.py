"""Fig. 14 and 1: what one object can be made to look like, solved, photographed and compared."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from controller.core.arrays import ByteImage, FloatImage
from controller.core.errors import VelaturaError
from controller.optics.solve.appearance import traditional_compensation
from controller.optics.solve.bounded.equations import SolveSettings, appearance_weights
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.solve.result.metrics import TITLES, PixelSet, colour_difference
from controller.optics.solve.targets.values import Target
from controller.optics.transport import build_transport
from controller.stage.report.pictures import Crop, crop_around, error_picture
from lab.study.experiments.appearances.targets import LOOKS, Look, as_it_is
from lab.study.experiments.residual import brightest_first
from lab.study.output.drawing import LabelledPicture, screen, strip
from lab.study.subject.measuring import Quality, pixel_sets, predicted, quality
from lab.study.subject.subject import ReachableTarget, Subject
from lab.study.values import Cell, Criterion, Experiment, Figure, Result, ResultTable

MOST_DELTA_E: Final = 1.0
"""In the median: about the smallest difference that people see side by side."""
MOST_DELTA_E_P95: Final = 4.0
"""In 95 % of the pixels: a difference that is seen where one looks for it."""
TIMES_BETTER: Final = 3.0
A_FIGURE: Final = 3
"""Appearances in one picture."""


@dataclass(frozen=True, slots=True)
class PhotographedLook:
    """One look, photographed.

    ``share`` of the object at the target's exposure in reach; ``ours``, ``model`` (what the light transport predicts of
    the same frames) and ``alone`` (one projector, same exposure) over the pixels in reach, ``whole`` ours over all lit
    ones, ``pixels`` ours by sets of pixels, ``alone_pixels`` those of one projector at the same exposure.
    At the exposure that one projector can reach by itself, ``dimmer`` times ours: ``alone_dimmed``, over the pixels
    that both can reach, and ``ours_there``, at our own exposure, over the same ones
    """

    look: Look
    wanted: ReachableTarget
    share: float
    photograph: FloatImage
    by_one: FloatImage
    ours: Quality
    whole: Quality
    pixels: dict[str, PixelSet]
    alone_pixels: dict[str, PixelSet]
    model: Quality
    alone: Quality
    dimmer: float
    alone_dimmed: Quality
    ours_there: Quality
    seconds: float


@dataclass(frozen=True, slots=True)
class LeftOut:
    look: Look
    reason: str


def appearances(subject: Subject) -> Result:
    """Make each look with all projectors, and with one as it was done before; photograph all."""
    best = brightest_first(subject)[0]
    alone = dataclasses.replace(
        subject, transport=build_transport(subject.with_projectors([best])), _drive=None
    )  # fmt: skip
    shown: list[PhotographedLook] = []
    left_out: list[LeftOut] = []
    for number, look in enumerate(LOOKS):
        on_progress = _progress(subject, look, number)
        on_progress(0.0, "target")
        try:
            target = look.make(subject, on_progress)
        except VelaturaError as error:  # of the target alone: a stage that fails ends the experiment
            left_out.append(LeftOut(look, error.what))
            continue
        shown.append(_shown(subject, alone, best, look, target))
    return Result(_criteria(shown, left_out), _tables(shown, left_out), _figures(subject, shown), TEXT)


def _progress(subject: Subject, look: Look, number: int) -> Callable[[float, str], None]:
    return lambda fraction, note: subject.advance((number + 0.5 * fraction) / len(LOOKS), f"{look.title}, {note}")


def _shown(subject: Subject, alone: Subject, best: int, look: Look, target: Target) -> PhotographedLook:
    wanted, dimmed = subject.wanted(target), alone.wanted(target)
    black, light = subject.calibration.black, subject.light
    began_s = time.perf_counter()
    settings = SolveSettings(weights=appearance_weights(wanted.radiance, wanted.mask, wanted.white))
    frames = solve_bounded(subject.transport, wanted.direct, black, settings).frames
    seconds = time.perf_counter() - began_s
    pictures = [
        light.photograph(f"{look.name}-{way}", shown, white=asked.white)
        for way, shown, asked in (
            ("ours", frames, wanted),
            ("one", traditional_compensation(subject.calibration, wanted.direct, best), wanted),
            ("one-dimmed", traditional_compensation(subject.calibration, dimmed.direct, best), dimmed),
        )
    ]
    both = wanted.mask & dimmed.mask
    return PhotographedLook(
        look=look,
        wanted=wanted,
        share=float(wanted.mask[subject.mask].mean()),
        photograph=pictures[0],
        by_one=pictures[1],
        ours=quality(subject, pictures[0], wanted),
        whole=quality(subject, pictures[0], wanted, target.mask & subject.mask),
        pixels=pixel_sets(subject, pictures[0], wanted),
        alone_pixels=pixel_sets(subject, pictures[1], wanted),
        model=quality(subject, predicted(subject, frames), wanted),
        alone=quality(subject, pictures[1], wanted),
        dimmer=dimmed.white / wanted.white,
        alone_dimmed=quality(subject, pictures[2], dimmed, both),
        ours_there=quality(subject, pictures[0], wanted, both),
        seconds=seconds,
    )


def _criteria(shown: Sequence[PhotographedLook], left_out: Sequence[LeftOut]) -> tuple[Criterion, ...]:
    every = len(shown) + len(left_out)
    found = [
        Criterion(
            f"all {every} kinds of appearance are made",
            f"{len(shown)} of {every}",
            not left_out,
            " ".join(f"{one.look.title}: {one.reason}" for one in left_out),
        )
    ]
    if shown:
        far = [one for one in shown if not _near(one.ours)]
        close = [one for one in shown if one.alone.delta_e < TIMES_BETTER * one.ours.delta_e]
        found += [
            Criterion(
                f"every appearance: CIEDE2000 at most {MOST_DELTA_E:g} in the median and {MOST_DELTA_E_P95:g} in 95 %"
                " where it is in reach",
                f"{len(shown) - len(far)} of {len(shown)}: " + "; ".join(map(_distance, shown)),
                not far,
                " ".join(map(_shortfall, far)),
            ),
            Criterion(
                f"every appearance: at least {TIMES_BETTER:g} times nearer than one projector at the same exposure",
                f"{len(shown) - len(close)} of {len(shown)}: " + "; ".join(map(_gain, shown)),
                not close,
                " ".join(map(_close, close)),
            ),
        ]
    return (*found, *_against_dimmed(shown))


def _against_dimmed(shown: Sequence[PhotographedLook]) -> list[Criterion]:
    """Whether superposition brings more than light: one projector's target is as dim as it needs, ours is not."""
    if not shown:
        return []
    pairs = {one.look.title: (one.ours_there, one.alone_dimmed) for one in shown}
    behind = [
        title for title, (ours, other) in pairs.items()
        if not (ours.delta_e < other.delta_e and ours.rmse < other.rmse and ours.ssim > other.ssim)
    ]  # fmt: skip
    gains = {title: other.delta_e / ours.delta_e for title, (ours, other) in pairs.items()}
    least, most = min(gains, key=gains.__getitem__), max(gains, key=gains.__getitem__)
    dims = sorted(one.dimmer for one in shown)
    return [
        Criterion(
            "each is nearer than one projector's at the exposure that this one can reach, in CIEDE2000, RMSE and SSIM",
            f"{gains[least]:.1f} ({least}) to {gains[most]:.1f} ({most}) times in CIEDE2000; that exposure is"
            f" {dims[0]:.2f} to {dims[-1]:.2f} of ours",
            not behind,
            f"Not nearer: {', '.join(behind)}." if behind else "",
        )
    ]


def _near(found: Quality) -> bool:
    return found.delta_e <= MOST_DELTA_E and found.delta_e_p95 <= MOST_DELTA_E_P95


def _distance(one: PhotographedLook) -> str:
    return (
        f"{one.look.title} {one.ours.delta_e:.2f} and {one.ours.delta_e_p95:.1f} on {one.share:.0%} of the object"
        f" ({one.whole.delta_e:.2f} and {one.whole.delta_e_p95:.1f} on all of it)"
    )


def _shortfall(one: PhotographedLook) -> str:
    model = f"{one.model.delta_e:.2f} in the median and {one.model.delta_e_p95:.1f} in 95 %"
    if not _near(one.model):
        return f"{one.look.title}: by the model, too, these frames come no nearer than {model}."
    return f"{one.look.title}: by the model {model}; the rest is the calibration's error and noise."


def _gain(one: PhotographedLook) -> str:
    ours, other = one.ours.delta_e, one.alone.delta_e
    return f"{one.look.title} {other:.2f} to {ours:.2f}, {other / ours:.1f} times"


def _close(one: PhotographedLook) -> str:
    return (
        f"{one.look.title}: half of it is within {one.alone.delta_e:.2f} with one projector, and calibration and noise"
        f" keep ours, by the model {one.model.delta_e:.2f}, at {one.ours.delta_e:.2f}; 95 % is within"
        f" {one.alone.delta_e_p95:.1f} with one and {one.ours.delta_e_p95:.1f} with ours."
    )


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 2)


def _tables(shown: Sequence[PhotographedLook], left_out: Sequence[LeftOut]) -> tuple[ResultTable, ...]:
    columns = (
        "appearance", "made by", "way", "compared", "exposure", "CIEDE2000 median", "95 %", "RMSE", "SSIM", "lambda",
        "left out of the visible object", "target",
    )  # fmt: skip
    rows: list[tuple[Cell, ...]] = []
    for one in shown:
        missing = {TITLES[name]: round(each.left_out_share, 4) for name, each in one.pixels.items()}
        for way, sets, names in (
            ("ours", one.pixels, ("visible",)),
            ("one projector", one.alone_pixels, ("lit", "visible")),
        ):
            for name in names:
                median, most = (_rounded(each) for each in (sets[name].delta_e00_median, sets[name].delta_e00_p95))
                rows.append(
                    (one.look.title, one.look.made_by, way, TITLES[name], 1.0, median, most, None, None, None,
                     missing[TITLES[name]], one.wanted.as_asked)
                )  # fmt: skip
        for way, compared, exposure, found in (
            ("ours", "in reach", 1.0, one.ours),
            ("ours", TITLES["lit"], 1.0, one.whole),
            ("ours, by the model", "in reach", 1.0, one.model),
            ("one projector", "in reach", 1.0, one.alone),
            ("ours", "in reach of one", 1.0, one.ours_there),
            ("one projector, dimmed", "in reach of one", one.dimmer, one.alone_dimmed),
        ):
            rows.append(
                (
                    one.look.title, one.look.made_by, way, compared, round(exposure, 3), round(found.delta_e, 2),
                    round(found.delta_e_p95, 2), round(found.rmse, 4), round(found.ssim, 4), round(found.sharpness, 3),
                    missing.get(compared), one.wanted.as_asked,
                )
            )  # fmt: skip
    looks: list[tuple[Cell, ...]] = [
        (one.look.title, one.look.made_by, "made", round(one.share, 3), round(one.seconds, 1), "") for one in shown
    ]
    looks += [(one.look.title, one.look.made_by, "left out", None, None, one.reason) for one in left_out]
    heads = ("appearance", "made by", "state", "of the object in reach", "seconds to solve", "why left out")
    return (
        ResultTable("looks", "What was made", heads, tuple(looks)),
        ResultTable("errors", "Photographed errors; exposure relative to ours", columns, tuple(rows)),
    )


def _figures(subject: Subject, shown: Sequence[PhotographedLook]) -> tuple[Figure, ...]:
    crop = crop_around(subject.mask)
    found = []
    for first in range(0, len(shown), A_FIGURE):
        some = shown[first : first + A_FIGURE]
        panels = [panel for one in some for panel in _panels(subject, one, crop)]
        names = ", ".join(one.look.title for one in some)
        found.append(
            Figure(
                f"photographs-{first // A_FIGURE + 1}",
                f"{names}: the object under white light, the target, our photograph of it and one projector's at the "
                "same exposure, each with its median CIEDE2000, and CIEDE2000 of ours (black 0, bright 12 and more; "
                "grey is out of reach and not compared).",
                strip(panels, columns=5),
            )
        )
    return tuple(found)


def _panels(subject: Subject, one: PhotographedLook, crop: Crop) -> list[LabelledPicture]:
    matrix, white = subject.calibration.camera_to_xyz, one.wanted.white
    difference = colour_difference(one.photograph, one.wanted.radiance, matrix, white, one.wanted.mask)
    error: ByteImage = np.ascontiguousarray(error_picture(difference, one.wanted.mask)[crop.rows, crop.columns])
    return [
        LabelledPicture("before", screen(as_it_is(subject), matrix, 1.0, crop)),
        LabelledPicture(f"target: {one.look.title}", screen(one.wanted.radiance, matrix, white, crop)),
        LabelledPicture(f"ours: {one.ours.delta_e:.2f}", screen(one.photograph, matrix, white, crop)),
        LabelledPicture(f"one projector: {one.alone.delta_e:.2f}", screen(one.by_one, matrix, white, crop)),
        LabelledPicture("error of ours", error),
    ]


TEXT = """\
One painted object gets all the appearances of the paper's figures. Blender renders its targets from the calibrated
shape, in the calibrated view; the others are made from its normals, its own coordinates and its photograph under white
light. Each is solved in full at the largest exposure that 95 % of the object can reach, and compared where it is in
reach. *One projector* is the method before superposition, a division at each pixel (Nayar 2003, Grossberg 2004), with
the projector that lights most of the object, and with our correction for the light that comes back from the room. It is
shown at our exposure, where it lacks light, and at the exposure that it can reach itself, where both are compared on
the pixels that it reaches.
Paint absorbs colours that no light can restore. Large parts of a blue glaze on yellow and red paint, and of bright
highlights, are out of reach: the figures *in reach* are without them, those of the *whole object* include them.
The lowered head bends everything at the same height, here the vase's neck. All is seen from the calibrating camera:
highlights, and shapes that do not exist, are correct only from there."""

APPEARANCES = Experiment(
    name="appearances",
    title="Appearances",
    paper="Paper 6, Fig. 14 and 1",
    shows="gloss, marble, inter-reflections, new light, new colours, a new pattern, leaves, and a lowered head.",
    scene="painted",
    run=appearances,
    cost_s=120.0,
)
