"""The step that looks for what makes several appearances err alike, and says what would correct the calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path

from controller.optics.solve.result.common_causes import Cause, CommonCauses, common_causes
from controller.run.runner import Context, Step
from controller.run.step_id import StepId
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.solved import Refining, write_causes
from hal.notices import Level


def causes_step(calibrated: Calibrated, names: Sequence[str], photographs: int, *, after: Sequence[StepId]) -> Step:
    """After the refining of these appearances, by at most so many photographs each."""
    return Step(
        StepId(StepKind.CAUSES),
        partial(_look, calibrated, tuple(names), photographs),
        after=tuple(after),
        title="Looking for common causes of the errors",
        weight=0.1,
    )


def _look(calibrated: Calibrated, names: Sequence[str], photographs: int, context: Context) -> Sequence[Path]:
    left = [Refining.read(context.folder, name, photographs, calibrated.projectors).equations for name in names]
    found = [one for one in left if one is not None]
    causes = common_causes(found, len(calibrated.projectors)) if len(found) > 1 else CommonCauses((), 0.0)
    lines = sentences(causes, calibrated.projectors)
    for text in lines:
        context.reporter.say(text, Level.WARNING)
    rows = [
        {**asdict(cause), "projector": None if cause.projector is None else calibrated.projectors[cause.projector]}
        for cause in causes.causes
    ]
    return [write_causes(context.folder, {"share": causes.share, "causes": rows, "sentences": lines})]


def sentences(found: CommonCauses, projectors: Sequence[str]) -> list[str]:
    """For people: each cause with how to correct the calibration; nothing where there is none."""
    if not found.causes:
        return []
    lines = [f"The appearances have {100 * found.share:.0f} % of their error (squared) in common."]
    for n, name in enumerate(projectors):
        of = [cause for cause in found.causes if cause.projector == n]
        colours = [cause for cause in of if cause.kind == "brightness"]
        if colours:
            lines.append(
                f"Projector {name} is not as bright as calibrated: {_by_colour(colours)}. `velatura calibrate STAGE "
                "--quick` measures it again."
            )
        lines += [
            f"The response of projector {name} has changed (exponents {100 * cause.amount:+.0f} %). See whether its "
            f"picture mode was changed, or run `velatura calibrate STAGE --projector {name}`."
            for cause in of
            if cause.kind == "response"
        ]
    return lines + _of_all(found.causes)


def _of_all(causes: Sequence[Cause]) -> list[str]:
    lines = []
    for cause in causes:
        if cause.kind == "indirect":
            more = (
                "comes back from the object and the room" if cause.amount > 0 else "no longer comes back from the room"
            )
            lines.append(
                f"{100 * abs(cause.amount):.0f} % of the projectors' light {more}. Cover pale surfaces; photographs of "
                "the results correct the rest."
            )
        elif cause.kind == "focus":
            sharper = "less sharp" if cause.amount > 0 else "sharper"
            lines.append(
                f"The pictures are {sharper} than when they were calibrated. Check the focus of projectors and camera, "
                "then run `velatura calibrate STAGE`."
            )
    ambient = [cause for cause in causes if cause.kind == "ambient"]
    if ambient:
        lines.append(
            f"The light in the room has changed, in parts of the projectors' light: {_by_colour(ambient)}. Make the "
            "room as dark as it was, or run `velatura calibrate STAGE`."
        )
    return lines


def _by_colour(causes: Sequence[Cause]) -> str:
    return ", ".join(f"{cause.colour} {100 * cause.amount:+.1f} %" for cause in causes)
