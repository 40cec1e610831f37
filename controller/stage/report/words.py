"""What a report says instead of the names of runs and steps, which are for programs."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from datetime import datetime, tzinfo
from typing import Final

from controller.run.step_id import StepId
from controller.stage.artefacts.kinds import StepKind as Kind

TIMES: Final[Mapping[str, tuple[str, ...]]] = {
    "Exposure, delay and the camera's response": (Kind.EXPOSURE, Kind.DELAY, Kind.CAMERA_RESPONSE, Kind.CAMERA),
    "Photographs of black and white": (Kind.BLACK, Kind.LIGHT),
    "Response of the projectors": (Kind.RADIOMETRY,),
    "Photographs of the patterns": (Kind.CODES, Kind.DOTS, Kind.STUDY_DOTS),
    "Where each projector pixel lands": (Kind.PIXELS, Kind.METAPIXELS),
    "Direct and indirect light": (Kind.INDIRECT,),
    "Geometry": (Kind.SHAPE, Kind.GEOMETRY),
    "Check with a random pattern": (Kind.VERIFICATION_PHOTOGRAPHS, Kind.VERIFY),
    "Drift check": (Kind.DRIFT_PHOTOGRAPHS, Kind.DRIFT, Kind.PLAN),
    "Base image": (Kind.BASE,),
    "Solving the appearances": (Kind.TARGET, Kind.APPEARANCE),
    "Refining with photographs": (Kind.REFINE, Kind.REFINED),
    "Bundle": (Kind.PUBLISH,),
    "Photographs of the result": (Kind.PHOTOGRAPH, Kind.TRADITIONAL, Kind.DIMMED, Kind.PLAYBACK),
    "Comparison with the targets": (Kind.COMPARE, Kind.PICTURES, Kind.CAUSES),
}
"""By what the time of a step was spent on."""
SUPERPOSITION: Final = (
    "With one projector nothing is superimposed. A second one beside it adds its light, fills shadows, gives finer "
    "detail between the pixels of the first, and shows the shape of an object that is not flat."
)
"""What more projectors would add."""
OTHER: Final = "Lamps and all else"
LEAST_S: Final = 0.05


def spent(steps: Mapping[StepId, float]) -> tuple[tuple[str, float], ...]:
    """Seconds by what they were spent on, in the order of a run; what took no time is left out."""
    words = {str(kind): text for text, kinds in TIMES.items() for kind in kinds}
    sums = dict.fromkeys([*TIMES, OTHER], 0.0)
    for step, seconds in steps.items():
        sums[words.get(step.kind, OTHER)] += seconds
    return tuple((text, seconds) for text, seconds in sums.items() if seconds >= LEAST_S)


When = Callable[[str], str]
"""``moment`` in the zone of a stage."""


def moment(run: str, zone: tzinfo | None = None) -> str:
    """When a run began, "24 Nov 2026, 14:54" of "20261124-145431-demo"; any other name stays as it is.

    The name has the computer's own time, and ``zone`` is that of the answer; None: the computer's.
    """
    if not re.match(r"[0-9]{8}-[0-9]{6}-", run):
        return run
    try:
        began = datetime.strptime(run[:15], "%Y%m%d-%H%M%S").astimezone(zone)
    except (ValueError, OverflowError):
        return run
    return f"{began.day} {began:%b %Y, %H:%M}"
