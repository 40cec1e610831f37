"""Photographs of a projector's white, code and mosaics, as many as are needed.

With few photographs, the code is shown in colours, and where the paint is too dark in one of them, in grey after all.
With the fewest, no code is shown: the map of the last calibration stands for it, if the mosaics are where it says.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from controller.core import channels
from controller.core.arrays import ByteImage, Float64
from controller.core.errors import UsageError
from controller.optics.calibrate.correspondence.gray_code import decode_colours
from controller.optics.calibrate.correspondence.known_map import MapCheck, check_map
from controller.optics.capture.pattern_frames import device_frame
from controller.optics.capture.patterns import Code, Pattern, PatternKind, PatternPlan, plan_patterns
from controller.run.background import beside
from controller.run.runner import Context
from controller.stage.artefacts.calibration import merge_photographs, read_black
from controller.stage.artefacts.camera import Exposures
from controller.stage.artefacts.pattern_plans import PhotographOptions, PlanUsed, known_map
from controller.stage.artefacts.photographs import (
    WHITE,
    Developed,
    TakenPhotograph,
    light_of,
    noise_of,
    white_bracket,
    white_name,
)
from controller.stage.artefacts.projectors import Indirect, IndirectFigures, Light
from controller.stage.rig.rig import Rig, RigProjector
from controller.stage.steps.capture.photographs import Planned, take_all

LEAST_READABLE: Final = 0.95
"""Share of the lit camera pixels whose coloured code is clear; with less, the code is shown in grey, too."""
CODE_AND_TILES: Final = (PatternKind.GRAY, PatternKind.COLOUR_GRAY, PatternKind.COLOUR_TILES)
"""Kinds of the patterns for the response, in the order in which they are photographed."""
LIT_SHARE: Final = 0.05
"""Of the 99th percentile of white's light: darker camera pixels are not asked."""


def expected_plan(size_px: tuple[int, int], options: PhotographOptions) -> PatternPlan:
    """The plan if everything goes well."""
    if options.photographs == "full":
        return plan_patterns(size_px)
    known = options.photographs == "fewest" and options.last is not None
    return plan_patterns(size_px, few=True, code=Code.KNOWN if known else Code.COLOURS)


def before_response(plan: PatternPlan) -> tuple[Pattern, ...]:
    """Patterns for the response: the code finds the mosaics' tiles."""
    return tuple(pattern for kind in CODE_AND_TILES for pattern in plan.of_kind(kind))


def named(plan: PatternPlan, name: str) -> Pattern:
    return next(pattern for pattern in plan if pattern.name == name)


def planned_pattern(
    projector: RigProjector, pattern: Pattern, exposure_s: float, response: Float64 | None, *, name: str = ""
) -> Planned:
    """The photograph of one pattern; ``response`` (3, 256) where the pattern needs it."""

    def frames() -> Mapping[str, ByteImage]:
        return {projector.name: device_frame(pattern, projector.size_px, response)}

    return Planned(name or pattern.name, frames, exposure_s)


def photograph_whites(rig: Rig, projector: RigProjector, context: Context) -> Sequence[Path]:
    """Photograph the bracket of white. The index of the projector's light lists it, and is no artefact of this step:
    ``photograph_light`` adds to it.
    """
    taking = _Taking(rig, projector, context)
    return taking.take_whites()[1:]


def photograph_light(rig: Rig, projector: RigProjector, options: PhotographOptions, context: Context) -> Sequence[Path]:
    """Photograph until the code is known; the last path is of ``PlanUsed``."""
    taking = _Taking(rig, projector, context)
    if options.photographs == "full":
        taking.take(plan_patterns(projector.size_px))
        return taking.done(PlanUsed())
    because = ""
    if options.photographs == "fewest":
        known, because = _known_code(taking, options.last)
        if known is not None:
            return taking.done(known)
    plan = plan_patterns(projector.size_px, few=True, code=Code.COLOURS)
    taking.take(plan, (PatternKind.COLOUR_GRAY,))
    # The mosaics are needed with any code, so the camera works while the code is read.
    readable = beside(partial(_readable, context.folder, taking.photographs(), plan), partial(taking.take, plan))
    if readable >= LEAST_READABLE:
        return taking.done(PlanUsed(few=True, code=Code.COLOURS, because=because))
    dark = f"The code in colours was clear on {100 * readable:.0f} % of the lit camera pixels: too dark paint."
    taking.take(plan_patterns(projector.size_px, few=True, code=Code.GRAY))
    return taking.done(PlanUsed(few=True, code=Code.GRAY, because=f"{because} {dark}".strip()))


class _Taking:
    """The photographs of one projector's light, in one index; what was taken before is not taken again."""

    def __init__(self, rig: Rig, projector: RigProjector, context: Context) -> None:
        self.rig, self.projector, self.context = rig, projector, context
        self.set = light_of(projector.name)
        self._exposures = Exposures.read(context.folder)[projector.name]
        white = named(plan_patterns(projector.size_px), WHITE)
        self._planned = [
            planned_pattern(projector, white, exposure_s, None, name=white_name(number))
            for number, exposure_s in enumerate(self._exposures.white_s)
        ]
        self._paths: list[Path] = []

    def take_whites(self) -> Sequence[Path]:
        """The index and the photographs of white."""
        return take_all(self.rig, self.context, self._planned, into=self.set)

    def take(self, plan: PatternPlan, kinds: Sequence[PatternKind] = CODE_AND_TILES) -> None:
        """Photograph what this plan has of these kinds and is not there."""
        have = {planned.name for planned in self._planned}
        self._planned += [
            planned_pattern(self.projector, pattern, self._exposures.base_s, None)
            for kind in kinds
            for pattern in plan.of_kind(kind)
            if pattern.name not in have
        ]
        self._paths = take_all(self.rig, self.context, self._planned, into=self.set)

    def photographs(self) -> dict[str, TakenPhotograph]:
        """By name, those taken so far."""
        return self.set.by_name(self.context.folder)

    def done(self, used: PlanUsed) -> Sequence[Path]:
        if used.because:
            self.context.reporter.say(f"Projector {self.projector.name} needs more photographs. {used.because}")
        return [*self._paths, used.write(self.context.folder, self.projector.name)]


def _known_code(taking: _Taking, last: Path | None) -> tuple[PlanUsed | None, str]:
    """The plan without code, if the last calibration's map holds; else why not."""
    if last is None:
        return None, ""
    name, size_px = taking.projector.name, taking.projector.size_px
    try:
        known_px, light = known_map(last, name), Light.read(last, name)
    except UsageError:
        return None, "The last calibration has no map of it."
    plan = plan_patterns(size_px, few=True, code=Code.KNOWN)
    taking.take(plan)
    captures, _ = _developed(taking.context.folder, taking.photographs())
    if captures["black"].shape[:2] != known_px.shape[:2]:
        return None, "The last calibration has another picture size."
    figures = IndirectFigures.read(last, name)
    share = None if figures is None else Indirect.read(last, name).share.astype(np.float32)
    check = check_map(captures, plan, known_px, light.radiometry, share=share)
    if check.holds:
        return PlanUsed(few=True, code=Code.KNOWN, known_from=last.name), ""
    return None, why_not(check)


def why_not(check: MapCheck) -> str:
    """Why the last calibration's map does not hold, in one sentence."""
    return (
        f"Something has moved since the last calibration: {100 * check.agreeing:.0f} % of the colour tiles are where "
        f"they were, {100 * check.covered:.0f} % of the lit camera pixels were seen before."
    )


def _developed(folder: Path, taken: Mapping[str, TakenPhotograph]) -> tuple[Developed, TakenPhotograph]:
    """Photographs of a projector with black and white merged, and one of them."""
    bracket = white_bracket(list(taken.values()))
    return Developed(taken, {"black": read_black(folder), "white": merge_photographs(bracket)}), bracket[0]


def _readable(folder: Path, taken: Mapping[str, TakenPhotograph], plan: PatternPlan) -> float:
    """Share of the lit camera pixels whose coloured code is clear."""
    captures, one = _developed(folder, taken)
    cells = decode_colours(captures, plan, noise_of(one))
    light = channels.total(np.nan_to_num(captures["white"] - captures["black"]))
    lit = light > LIT_SHARE * np.percentile(light[::7, ::7], 99)
    return float(np.mean((cells[0].sure & cells[1].sure)[lit])) if lit.any() else 0.0


__all__ = [
    "before_response",
    "expected_plan",
    "named",
    "photograph_light",
    "photograph_whites",
    "planned_pattern",
    "why_not",
]
