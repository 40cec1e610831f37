"""Grades a run's calibration, shows where it is bad and why, and refuses one below the limit."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from controller.artefacts.calibrated import Calibrated
from controller.artefacts.camera import Exposures
from controller.artefacts.geometry import has_geometry, read_geometry
from controller.artefacts.grade import (
    PICTURE,
    ErrorMaps,
    graded,
    in_rows,
    passes,
    read_grade_figures,
    worst_letter,
    worst_of,
    write_accepted,
    write_grade,
)
from controller.artefacts.kinds import StepKind
from controller.artefacts.photographs import PATTERN, VERIFICATION, Taken, codes_of
from controller.artefacts.projectors import IndirectFigures, Light
from controller.bundle.export import png
from controller.calibrate.photometry.glare import veiled, veiling_glare
from controller.calibrate.photometry.gloss import gloss_strength, glossy
from controller.calibrate.values import ProjectorCalibration
from controller.calibrate.verify.error_attribution import ErrorAttribution, attribute_error, attribution_picture, ranked
from controller.calibrate.verify.grade import Verification, verify
from controller.capture.pattern_frames import device_frame, frame
from controller.capture.patterns import Pattern
from controller.core.arrays import ByteImage, FloatImage
from controller.core.errors import CalibrationError
from controller.rig.rig import Rig
from controller.run.progress import Level, Reporter
from controller.run.runner import Context, Step
from controller.run.step_id import StepId
from controller.solve.scaling.dither import to_light
from controller.steps import costs
from controller.steps.appearance.solving import random_pattern
from controller.steps.calibrate.drift import shown_frames
from controller.steps.capture.photographs import Planned, take_all

WORSE = 1.25
"""Warn about a calibration this many times worse than the previous one, even if its grade is sufficient."""


def verify_step(calibrated: Calibrated, after: Sequence[StepId], scale: float) -> Step:
    """Predict each projector's random pattern and compare with its photograph."""
    return Step(
        StepId(StepKind.VERIFY),
        partial(_verify, calibrated),
        after=tuple(after),
        title="Grading the calibration",
        weight=costs.VERIFY_S * scale,
    )


def verification_photographs_step(rig: Rig, calibrated: Calibrated, after: Sequence[StepId]) -> Step:
    """Photograph the random pattern again, for a corrected calibration."""
    scale = costs.scale(projector.size_px for projector in rig.projectors)
    return Step(
        StepId(StepKind.VERIFICATION_PHOTOGRAPHS),
        partial(_photograph, rig, calibrated),
        after=tuple(after),
        title="Photographing the pattern for the grade",
        weight=costs.shot_s(scale) * len(rig.projectors),
    )


def _photograph(rig: Rig, calibrated: Calibrated, context: Context) -> Sequence[Path]:
    exposures = Exposures.read(context.folder)
    plan = []
    for projector in rig.projectors:
        image = shown_frames(calibrated, random_pattern(projector.size_px))[projector.name]
        shown = partial(_one, projector.name, image)
        plan.append(Planned(PATTERN, shown, exposures[projector.name].base_s, projector=projector.name))
    return take_all(rig, context, plan, into=VERIFICATION)


def _one(name: str, image: ByteImage) -> dict[str, ByteImage]:
    return {name: image}


def _taken(folder: Path, projector: str, pattern: Pattern) -> Taken:
    if VERIFICATION.index(folder).exists():
        return VERIFICATION.by_projector(folder)[projector]
    return codes_of(projector).by_name(folder)[pattern.name]


def _verify(calibrated: Calibrated, context: Context) -> Sequence[Path]:
    calibration, transport = calibrated.calibration, calibrated.transport
    figures, pictures = {}, []
    maps: dict[str, ErrorMaps] = {}
    for n, part in enumerate(calibration.projectors):
        context.advance(n / len(calibration.projectors), part.name)
        rows, columns = part.metapixels.valid.shape
        pattern = random_pattern((columns, rows))
        shown = _shown(context.folder, part, pattern, (columns, rows))
        light, indirect = transport.forward_part(n, shown), calibrated.indirect_of(n, shown)
        taken = _taken(context.folder, part.name, pattern)
        seen = taken.per_second()
        expected = light + calibration.black if indirect is None else light + indirect + calibration.black
        found = verify(expected, seen, calibration.black, transport.lit[n])
        why = attribute_error(
            transport, calibration, n, shown, seen, exposure_s=taken.exposure_s, indirect=indirect
        )  # fmt: skip
        figures[part.name] = _figures(found, why) | _indirect_figures(context.folder, part.name)
        maps[part.name] = ErrorMaps(found.error_map, why.labels)
        pictures.append(attribution_picture(why, calibration, part.name))
    geometry = read_geometry(context.folder, calibrated.projectors) if has_geometry(context.folder) else None
    for said in glossy(gloss_strength(calibration, geometry)), veiled(veiling_glare(calibration, geometry)):
        if said is not None:
            context.reporter.say(said, Level.WARNING)
    return write_grade(context.folder, figures, maps, png(in_rows(pictures)))


def _shown(folder: Path, part: ProjectorCalibration, pattern: Pattern, size_px: tuple[int, int]) -> FloatImage:
    """The light of the pattern: its device values may have been chosen by a response that was corrected since."""
    meant = frame(pattern, size_px)
    again = VERIFICATION.index(folder).exists()
    if part.radiometry.segment == 0 and (part.indirect is None or again):
        return meant
    response = part.radiometry.response if again else Light.read(folder, part.name).response
    return to_light(device_frame(pattern, size_px, response), part.radiometry)


def _indirect_figures(folder: Path, projector: str) -> dict[str, object]:
    figures = IndirectFigures.read(folder, projector)
    return {} if figures is None else {"indirect": {"median": figures.median, "p95": figures.p95}}


def _figures(found: Verification, why: ErrorAttribution) -> dict[str, object]:
    return {
        "relative_rms": found.relative_rms,
        "without_gain_rms": found.without_gain_rms,
        "gain": found.gain,
        "grade": found.grade.value,
        "reasons": ranked(why),
    }


def grade_figures(folder: Path) -> dict[str, str]:
    """For a command's result: the grade, each projector's error, and the error map."""
    figures = graded(folder) or {}
    text = ", ".join(f"{name} {percent:.2f} %" for name, percent in figures.items())
    return {"grade": worst_letter(folder), "error": text, "map": str(folder / PICTURE)} if figures else {}


def accept(folder: Path, reporter: Reporter, worst_grade: float) -> None:
    """Accept a calibration below the limit, with a warning; no effect on one that passes."""
    worst = worst_of(folder)
    if worst is None or passes(folder, worst_grade):
        return
    write_accepted(folder, *worst)
    reporter.say(
        f"ACCEPTED ON REQUEST although it is below the set grade: {worst[0]} is predicted with {worst[1]:.1f} % error, "
        f"and {worst_grade:g} % is the limit. What is made from it will look wrong where {PICTURE} shows colour.",
        Level.WARNING,
    )


def below_grade(folder: Path, worst_grade: float) -> CalibrationError:
    """The error for a calibration below the limit."""
    name, percent = worst_of(folder) or ("", float("nan"))
    reasons = read_grade_figures(folder)[name].get("reasons", [])
    because = f" {reasons[0]['sentence']}" if reasons else ""
    return CalibrationError(
        "calibration-below-grade",
        what=f"The calibration {folder.name} is not good enough to be published: projector {name} is predicted with "
        f"{percent:.1f} % error, and {worst_grade:g} % is the limit (worst_grade under [calibration]).{because}",
        remedy=f"Check {folder / PICTURE}, correct the cause and calibrate again. To publish it anyway, use "
        "--accept-grade.",
    )


def gate_step(worst_grade: float, *, accepted: bool, reporter: Reporter | None = None) -> Step:
    """Refuse a calibration below the limit. Raises CalibrationError("calibration-below-grade")."""

    def run(context: Context) -> Sequence[Path]:
        require(context.folder, worst_grade, accepted=accepted, reporter=reporter or context.reporter)
        return ()

    return Step(StepId("gate"), run, title="Comparing the grade with the limit", weight=0.01, always=True)


def require(folder: Path, worst_grade: float, *, accepted: bool, reporter: Reporter) -> None:
    """The check itself. Raises CalibrationError("calibration-below-grade")."""
    if accepted:
        accept(folder, reporter, worst_grade)
    if not passes(folder, worst_grade):
        raise below_grade(folder, worst_grade)


def compare_with_last(folder: Path, last: Path | None, reporter: Reporter) -> None:
    """Warn if a new calibration is worse than the one that it replaces."""
    now, then = worst_of(folder), None if last is None else worst_of(last)
    if last is not None and now is not None and then is not None and now[1] > WORSE * then[1]:
        reporter.say(
            f"This calibration is worse than the last: {now[1]:.1f} % error ({now[0]}) against {then[1]:.1f} % "
            f"({then[0]}) in {last.name}. {PICTURE} in {folder.name} shows where.",
            Level.WARNING,
        )


__all__ = [
    "accept", "below_grade", "compare_with_last", "gate_step", "grade_figures", "random_pattern", "require",
    "verification_photographs_step", "verify_step",
]  # fmt: skip
