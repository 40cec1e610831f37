"""The steps from a calibration to frames: transport, the base, and every appearance."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final

from controller.config.models import SolveTable
from controller.core.arrays import ByteImage, FloatImage
from controller.core.storage import sha256_of
from controller.optics.calibrate.values import Calibration
from controller.optics.capture.patterns import Pattern, PatternKind, plan_patterns
from controller.optics.solve.appearance import Base, base_image, solve_base
from controller.optics.solve.bounded.engine import SolveContext
from controller.optics.solve.bounded.equations import SolveSettings
from controller.optics.solve.memory_need import check_memory, solve_peak_bytes, stage_size
from controller.optics.solve.reach.feasibility import HELD_BACK, SMALL_PART
from controller.optics.solve.request import AppearanceResult, SheetOf, SolveOptions, continued, solve_appearance
from controller.optics.solve.scaling.dither import to_device
from controller.optics.solve.targets.values import Target
from controller.run.runner import Context, Step
from controller.run.step_id import StepId
from controller.stage.artefacts.calibrated import Calibrated, share_above
from controller.stage.artefacts.grade import FIGURES
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.outline import outline_digest
from controller.stage.artefacts.solved import RequestedTarget, Solved, SolvedBase
from controller.stage.steps import costs
from hal.notices import Level
from hal.runtime.compute import free_bytes

BASE = StepId(StepKind.BASE)
FEW: Final = 0.01
"""Of what several views see: less than this need not be known."""
MOSTLY: Final = 0.5
"""A target of which less is in reach is mostly out of reach."""


def options_of(table: SolveTable) -> SolveOptions:
    """How appearances are solved by [solve] of stage.toml, wherever they are."""
    return SolveOptions(table.exposure_share, table.smoothness, table.base, table.adapt, unseen=table.unseen)


@dataclass(frozen=True, slots=True)
class AppearanceRequest:
    """An appearance to solve: ``target`` gives its picture, like reflectance, and a mask of its valid pixels.

    ``inputs`` are the hashes of the target's sources; ``prepare``, if given, is a step before
    the solving, for slow targets; ``preparing`` is what it does, and ``prepare_s`` its cost. ``sheet``: where no camera
    sees, the light continues by it.
    """

    name: str
    title: str
    target: Callable[[], Target]
    inputs: dict[str, str]
    prepare: Callable[[Context], Sequence[Path]] | None = None
    prepare_s: float = 0.0
    preparing: str = "Rendering"
    sheet: SheetOf | None = None


def solve_steps(
    calibrated: Calibrated,
    requests: Sequence[AppearanceRequest],
    options: SolveOptions,
    after: Sequence[StepId],
    scale: float = 1.0,
    *,
    answering: Answering | None = None,
) -> list[Step]:
    """Solve the base, then each request.

    ``after``: the steps whose artefacts are read; ``scale``: the stage's size, see ``steps.costs``; ``answering``
    solves the appearances elsewhere.
    """
    outline = outline_digest(calibrated.folder)
    drawn = {"outline": outline} if outline else {}
    if len(calibrated.names) > 1:
        # one that is added or photographed again later
        graded = [folder / FIGURES for folder in calibrated.folders[1:]]
        drawn["views"] = " ".join((*calibrated.names, *(sha256_of(file) for file in graded if file.exists())))
    steps = [
        Step(
            BASE,
            partial(_solve_base, calibrated, options),
            inputs=options.base_inputs() | drawn,
            after=tuple(after),
            title="Solving the base image",
            weight=costs.BASE_S * scale,
        )
    ]
    for request in requests:
        before = (*after, BASE)
        if request.prepare is not None:
            rendered = StepId(StepKind.TARGET, item=request.name)
            steps.append(
                Step(
                    rendered,
                    request.prepare,
                    inputs=request.inputs | drawn,
                    after=tuple(after),
                    title=f"{request.preparing} {request.title}",
                    weight=request.prepare_s * scale,
                )
            )
            before = (*before, rendered)
        steps.append(
            Step(
                StepId(StepKind.APPEARANCE, item=request.name),
                partial(_solve_appearance, calibrated, request, options, answering),
                inputs={**options.inputs(), **request.inputs, **drawn},
                after=before,
                title=f"Solving {request.title}",
                weight=costs.APPEARANCE_S * scale,
            )
        )
    return steps


def random_pattern(size_px: tuple[int, int]) -> Pattern:
    """The pattern on which a calibration is graded."""
    return plan_patterns(size_px).of_kind(PatternKind.RANDOM)[0]


def _solve_base(calibrated: Calibrated, options: SolveOptions, context: Context) -> Sequence[Path]:
    need = solve_peak_bytes(stage_size(calibrated.calibration))
    context.reporter.say(check_memory(need, free_bytes()))
    base = solved_base(calibrated, options, _watched(context))
    calibrated.keep_base(base)
    return [
        path
        for view in calibrated.views()
        for path in SolvedBase(view.own_light(base.image), base.solution).write(view.folder, calibrated.projectors)
    ]


def solved_base(
    calibrated: Calibrated, options: SolveOptions, progress: Callable[[int, float], None] | None = None
) -> Base:
    """The base image for these options. Raises as ``solve_bounded``."""
    black = calibrated.calibration.black
    image = base_image(calibrated.calibration, options.base)
    settings, context = SolveSettings(options.smoothness), SolveContext(calibrated.engine, progress)
    return solve_base(calibrated.transport, image, black, settings, context)


def _watched(context: Context) -> Callable[[int, float], None]:
    """Reports the progress of a solve whose end is unknown; a stop request raises here."""

    def progress(iteration: int, kkt: float) -> None:
        context.advance(1 - 1 / (1 + iteration / 60), f"iteration {iteration}")

    return progress


Answering = Callable[[AppearanceRequest, SolveOptions, Context], AppearanceResult]
"""Solves an appearance, here or elsewhere."""


def answer_here(
    calibrated: Calibrated, request: AppearanceRequest, options: SolveOptions, context: Context
) -> AppearanceResult:
    """An ``Answering`` by this computer."""
    solving = SolveContext(calibrated.engine, _watched(context), folder=calibrated.folder)
    return solve_appearance(calibrated.light, request.target(), options, solving)


def _solve_appearance(
    calibrated: Calibrated,
    request: AppearanceRequest,
    options: SolveOptions,
    answering: Answering | None,
    context: Context,
) -> Sequence[Path]:
    began_s = time.perf_counter()
    made = (answering or partial(answer_here, calibrated))(request, options, context)
    if request.sheet is not None and options.unseen == "smooth":
        made = replace(made, frames=continued(calibrated.transport, made.frames, request.sheet))
    for line in _limits(request.title, made.figures, options.share):
        context.reporter.say(line, Level.WARNING)
    differs = calibrated.differences(made.target, made.valid, float(str(made.figures["exposure"])))
    differ = 0.0 if differs is None else share_above(differs)
    if differ > FEW:
        context.reporter.say(
            f"{request.title}: views ask for different colours on {differ:.0%} of what several of them see, and get "
            "something between. `velatura report STAGE` shows where.",
            Level.WARNING,
        )
    figures: dict[str, object] = {
        "name": request.name,
        "title": request.title,
        **made.figures,
        **({} if differs is None else {"views_differ_share": differ}),
        "seconds_with_target": time.perf_counter() - began_s,
    }
    solved = Solved(
        frames=device_frames(calibrated.calibration, made.frames),
        linear=dict(zip(calibrated.projectors, made.frames, strict=True)),
        target=made.target,
        reachable=made.reachable,
        figures=figures,
        asked=RequestedTarget(made.asked, made.asked_reachable, made.valid),
        differs=differs,
    )
    return [
        path
        for folder, part, gain in calibrated.views()
        for path in solved.seen(part, gain).write(folder, request.name)
    ]


def _limits(title: str, figures: Mapping[str, object], asked: float) -> list[str]:
    """What people should know of a target that the stage can't make well; ``asked``: the share to be in reach."""
    lines = []
    share, held_back = figures["reachable_share"], figures.get("held_back")
    if isinstance(share, float) and share < MOSTLY:
        lines.append(
            f"{title}: only {share:.0%} of the object can be shown as asked for; the rest asks for stronger colours, "
            "or for more or less light, than the projectors can make there. Choose paler colours or a target nearer to "
            "the object's own paint, or make the room darker."
        )
    if isinstance(held_back, float) and held_back > HELD_BACK:
        lines.append(
            f"{title}: a small dark part of the object decides how bright all is: without it, white could be "
            f"{held_back:.2f} times as bright. Put more light or paler paint there, or give it up with "
            f"exposure_share = {max(asked - SMALL_PART, SMALL_PART):.2g} under [solve] in stage.toml."
        )
    return lines


def device_frames(calibration: Calibration, frames: Sequence[FloatImage]) -> dict[str, ByteImage]:
    """8-bit frames by projector name, dithered."""
    parts = zip(calibration.projectors, frames, strict=True)
    return {part.name: to_device(values, part.radiometry) for part, values in parts}


__all__ = ["AppearanceRequest", "SolveOptions", "device_frames", "options_of", "solve_steps"]
