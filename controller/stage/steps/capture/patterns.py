"""The steps that photograph patterns: exposure, black, white, then Gray code, mosaics and sinusoids."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from controller.optics.capture.patterns import CELL_PX, Pattern, PatternPlan
from controller.run.runner import Context, Step
from controller.run.step_id import StepId
from controller.stage.artefacts.camera import Delay, Exposures
from controller.stage.artefacts.kinds import StepKind, white_of
from controller.stage.artefacts.pattern_plans import PhotographOptions
from controller.stage.artefacts.photographs import BLACK, codes_of
from controller.stage.artefacts.projectors import Light, write_drawn_by
from controller.stage.rig.rig import Rig, RigProjector
from controller.stage.steps import costs
from controller.stage.steps.capture.camera import delay_step, response_steps
from controller.stage.steps.capture.exposure import White, bracket, white_exposures
from controller.stage.steps.capture.light import (
    before_response,
    expected_plan,
    photograph_light,
    photograph_whites,
    planned_pattern,
)
from controller.stage.steps.capture.photographs import Planned, take_all, use_delay

WHITE_EXPOSURES = 3
"""Maximum number of photographs for one HDR white image."""
MOST_CHANGED = 1.6
"""Factor by which an exposure of a bracket may change to be another projector's, too: brackets overlap widely."""
BLACK_BRACKET = (8.0, 32.0)
"""Exposures of the HDR black image, relative to the one at which white is well exposed."""


def capture_steps(rig: Rig, *, longest_exposure_s: float) -> list[Step]:
    """Exposures, delay, black and white of all projectors: what is needed to measure the camera."""
    inputs = {"longest_exposure_s": repr(longest_exposure_s), "sizes": _sizes(rig)}
    a_shot_s = _shot_s(rig)
    steps = [
        delay_step(rig, longest_exposure_s),
        Step(
            StepId(StepKind.EXPOSURE),
            lambda context: _find_exposures(rig, context, longest_exposure_s),
            inputs=inputs,
            after=(StepId(StepKind.DELAY),),
            title="Finding the exposure",
            weight=2 * len(rig.projectors) * a_shot_s,
        ),
        *response_steps(rig),
        Step(
            StepId(StepKind.BLACK),
            lambda context: _photograph_black(rig, context, longest_exposure_s),
            inputs=inputs,
            after=(StepId(StepKind.EXPOSURE), StepId(StepKind.DELAY)),
            title="Photographing black",
            weight=3 * a_shot_s,
        ),
    ]
    for projector in rig.projectors:
        steps.append(
            Step(
                white_of(projector.name),
                partial(photograph_whites, rig, projector),
                inputs=inputs,
                after=(StepId(StepKind.EXPOSURE), StepId(StepKind.DELAY)),
                title=f"Photographing the white of {projector.name}",
                weight=a_shot_s * WHITE_EXPOSURES,
            )
        )
    return steps


def light_step(rig: Rig, projector: RigProjector, options: PhotographOptions | None = None) -> Step:
    """The step that photographs code and mosaics, for the radiometry."""
    options = options or PhotographOptions()
    plan = expected_plan(projector.size_px, options)
    after = [StepId(StepKind.EXPOSURE), StepId(StepKind.DELAY), white_of(projector.name)]
    return Step(
        StepId(StepKind.LIGHT, projector.name),
        partial(photograph_light, rig, projector, options),
        inputs={"sizes": _sizes(rig), "patterns": _patterns(plan), **options.inputs()},
        # with few photographs, the first ones say which others are needed
        after=(*after, StepId(StepKind.BLACK)) if options.inputs() else tuple(after),
        title=f"Photographing the light of {projector.name}",
        weight=_shot_s(rig) * len(before_response(plan)),
    )


def code_step(rig: Rig, projector: RigProjector, options: PhotographOptions | None = None) -> Step:
    """The step that photographs the sinusoids and the random pattern, after the radiometry."""
    options = options or PhotographOptions()
    plan = expected_plan(projector.size_px, options)
    # the code is photographed before, so the sinusoids are the same whichever it was
    coded = [pattern for pattern in plan if pattern.needs_response]
    return Step(
        StepId(StepKind.CODES, projector.name),
        lambda context: _photograph_codes(rig, projector, coded, context),
        inputs={"sizes": _sizes(rig), "patterns": _patterns(plan)},
        after=(StepId(StepKind.EXPOSURE), StepId(StepKind.RADIOMETRY, projector.name)),
        title=f"Photographing the patterns of {projector.name}",
        weight=_shot_s(rig) * len(coded),
    )


def _shot_s(rig: Rig) -> float:
    return costs.shot_s(costs.scale(projector.size_px for projector in rig.projectors))


def _find_exposures(rig: Rig, context: Context, longest_s: float) -> Sequence[Path]:
    found = {}
    use_delay(rig, context.folder)
    all_s = Delay.read(context.folder).exposure_s
    for number, projector in enumerate(rig.projectors):
        context.advance(number / len(rig.projectors), projector.name)
        white = White((projector,), f"projector {projector.name}", all_s)
        exposures_s = white_exposures(rig, context, white, longest_s, most=WHITE_EXPOSURES)
        found[projector.name] = Exposures(exposures_s[0], exposures_s)
    return [Exposures.write(context.folder, linked(found))]


def linked(found: Mapping[str, Exposures]) -> dict[str, Exposures]:
    """The exposures by projector, with one at least that an earlier projector's white has, too, if one is near.

    A camera's times may differ from what it says, and a bracket shows the ratios of its own alone. A projector whose
    bracket has none in common with the others would seem brighter or darker than these.
    """
    kept: dict[str, Exposures] = {}
    for name, one in found.items():
        used = {value for other in kept.values() for value in other.white_s}
        kept[name] = one if not used or used & set(one.white_s) else _with_one_of(used, one)
    return kept


def _with_one_of(used: set[float], one: Exposures) -> Exposures:
    """The bracket with the exposure that has to change least, not its first, replaced by one of ``used``."""
    own = one.white_s
    changes = [
        (abs(math.log(value / own[at])), at, value)
        for at in range(1, len(own))
        for value in sorted(used)
        if own[at - 1] < value and (at + 1 == len(own) or value < own[at + 1])
    ]
    nearest = min(changes, default=None)
    if nearest is None or nearest[0] > math.log(MOST_CHANGED):
        return one
    _, at, value = nearest
    return Exposures(one.base_s, (*own[:at], value, *own[at + 1 :]))


def _photograph_black(rig: Rig, context: Context, longest_s: float) -> Sequence[Path]:
    base_s = max(found.base_s for found in Exposures.read(context.folder).values())
    exposures = bracket(base_s, BLACK_BRACKET, rig.acquirer.exposures_s(), longest_s)
    plan = [Planned(str(number), dict, exposure_s) for number, exposure_s in enumerate(exposures)]
    return take_all(rig, context, plan, into=BLACK)


def _photograph_codes(rig: Rig, projector: RigProjector, coded: Sequence[Pattern], context: Context) -> Sequence[Path]:
    paths: list[Path] = []
    response = None if rig.drawn_by is None else rig.drawn_by(projector.name, context.deadline)
    if response is None:
        response = Light.read(context.folder, projector.name).response
    else:
        paths.append(write_drawn_by(context.folder, projector.name, response))
    base_s = Exposures.read(context.folder)[projector.name].base_s
    planned = [planned_pattern(projector, pattern, base_s, response) for pattern in coded]
    return [*take_all(rig, context, planned, into=codes_of(projector.name)), *paths]


def _patterns(plan: PatternPlan) -> str:
    """Identifies a plan: a run that was started with other patterns takes these again."""
    return hashlib.sha256(f"{CELL_PX} {plan}".encode()).hexdigest()[:16]


def _sizes(rig: Rig) -> str:
    return " ".join(f"{p.name}:{p.output}:{p.size_px[0]}x{p.size_px[1]}" for p in rig.projectors)


__all__ = ["capture_steps", "code_step", "light_step", "linked"]
