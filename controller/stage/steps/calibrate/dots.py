"""The steps of the paper's mode, which fits all metapixels to dots (paper 4.1, 4.2)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Final

from controller.core.arrays import FloatImage
from controller.optics.calibrate.metapixels.from_dots import (
    DotReport,
    fit_dots,
    initial_metapixels,
    modelled_correspondence,
    where_missing,
)
from controller.optics.calibrate.metapixels.pixel_status import pixel_status, status_counts
from controller.optics.calibrate.metapixels.regularize import regularize
from controller.optics.calibrate.values import Metapixels
from controller.optics.capture.patterns import DotPattern, dot_frame, dot_patterns
from controller.run.runner import Context, Step
from controller.run.step_id import StepId
from controller.stage.artefacts.calibration import read_correspondence
from controller.stage.artefacts.geometry import known_geometry
from controller.stage.artefacts.kinds import StepKind, of_projectors
from controller.stage.artefacts.photographs import Developed, PhotographSet, TakenPhotograph
from controller.stage.artefacts.projectors import DotMetapixels, DotNotes, Light, write_dot_figures
from controller.stage.rig.rig import Rig, RigProjector
from controller.stage.steps import costs
from controller.stage.steps.capture.dots import (
    check_disk,
    dot_exposure_s,
    of_sinusoids,
    planned,
    read_batches,
    spacing_of,
    take_in_batches,
)
from controller.stage.steps.modes import DotOptions, mode_step

CLEAR_GAIN: Final = 0.2
"""Regularity above which a fitted centre is corrected; below it, correction of folds and noise makes it worse."""
EXPECTED_SPACING_PX: Final = 7
"""For the estimate of the time left, before the blur is measured."""


def dot_steps(rig: Rig, options: DotOptions, *, longest_exposure_s: float) -> list[Step]:
    """The steps that a mode adds to ``calibration_steps``; for "fast" only the note of the mode."""
    steps: list[Step] = []
    for projector in rig.projectors:
        if options.mode == "paper":
            steps.append(capture_step(rig, projector, options, longest_exposure_s))
            steps.append(_fit_step(projector, options))
    return [*steps, mode_step(options, [step.id for step in steps])]


def capture_step(
    rig: Rig, projector: RigProjector, options: DotOptions, longest_s: float, *, kind: StepKind = StepKind.DOTS
) -> Step:
    """Photograph a projector's dots; ``kind``: of the step, its photographs and its notes."""
    return Step(
        StepId(kind, projector.name),
        partial(_photograph, rig, projector, options, longest_s, PhotographSet(kind, projector.name)),
        inputs={"longest_exposure_s": repr(longest_s), **options.inputs()},
        after=(StepId(StepKind.EXPOSURE), StepId(StepKind.PIXELS, projector.name)),
        title=f"Photographing the dots of {projector.name}",
        weight=costs.shot_s(costs.scale([projector.size_px])) * _expected_shots(projector, options),
    )


def _fit_step(projector: RigProjector, options: DotOptions) -> Step:
    name = projector.name
    own = of_projectors([name], StepKind.RADIOMETRY, StepKind.PIXELS, StepKind.DOTS)
    return Step(
        StepId(StepKind.METAPIXELS, name),
        partial(_fit, projector),
        inputs=options.inputs(),
        after=(StepId(StepKind.BLACK), StepId(StepKind.GEOMETRY), *own),
        title=f"Fitting the metapixels of {name} to its dots",
        weight=costs.dots_s(costs.scale([projector.size_px]), _expected_shots(projector, options)),
    )


def _expected_shots(projector: RigProjector, options: DotOptions) -> int:
    return len(dot_patterns(projector.size_px, options.spacing_px or EXPECTED_SPACING_PX))


def _photograph(
    rig: Rig, projector: RigProjector, options: DotOptions, longest_s: float, into: PhotographSet, context: Context
) -> Sequence[Path]:
    known = of_sinusoids(context.folder, projector.name)
    spacing = spacing_of(options, known)
    patterns = dot_patterns(projector.size_px, spacing)
    check_disk(context.folder, into, len(patterns))
    exposure_s = dot_exposure_s(rig, context.folder, projector.name, known, longest_s)
    plan = [
        planned(projector, _photograph_name(pattern), partial(dot_frame, pattern, projector.size_px), exposure_s)
        for pattern in patterns
    ]
    paths = take_in_batches(rig, context, plan, into=into)
    notes = DotNotes(spacing, exposure_s).write(context.folder, into.kind, projector.name)
    return [notes, *paths]


def _photograph_name(pattern: DotPattern) -> str:
    """Dots with another spacing are different photographs."""
    return f"{pattern.spacing_px:02d}-{pattern.name}"


def read_dots(folder: Path, of: PhotographSet, patterns: Sequence[DotPattern]) -> dict[str, TakenPhotograph]:
    """The photographs of the dots of one projector, by the pattern's name."""
    taken = {item.name: item for item in read_batches(folder, of, len(patterns))}
    return {pattern.name: taken[_photograph_name(pattern)] for pattern in patterns}


def _fit(projector: RigProjector, context: Context) -> Sequence[Path]:
    folder, name = context.folder, projector.name
    light = Light.read(folder, name)
    spacing = DotNotes.read(folder, StepKind.DOTS, name).spacing_px
    taken = read_dots(folder, PhotographSet(StepKind.DOTS, name), dot_patterns(projector.size_px, spacing))
    geometry = known_geometry(folder, [name])
    start = initial_metapixels(read_correspondence(folder, name), projector.size_px)
    model = None
    if geometry is not None:
        model = initial_metapixels(modelled_correspondence(geometry, 0), projector.size_px)
        start = where_missing(start, model)
    fitted, report = fit_dots(
        Developed(taken, {"black": light.black}),
        light.white,
        start,
        spacing,
        fallback=model,
        progress=lambda share: context.advance(0.95 * share, "dots"),
    )
    found, moves = regularize(fitted, least_gain=CLEAR_GAIN)
    return _save(folder, name, found, report, light.white, {"spacing_px": spacing, "moved": moves})


def _save(
    folder: Path, name: str, found: Metapixels, report: DotReport, white: FloatImage, figures: Mapping[str, object]
) -> list[Path]:
    why = pixel_status(found, white)
    arrays = DotMetapixels(found.centre_px, found.covariance_px2, found.valid, why)
    content = {**figures, **asdict(report), "reasons": status_counts(why)}
    return [arrays.write(folder, name), write_dot_figures(folder, name, content)]
