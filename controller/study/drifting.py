"""Beyond the paper: what a bump costs while nobody notices, whether the drift check does, and what mends it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from controller.calibrate.drift import Culprit, Drift
from controller.study.drawing import Line, plotted
from controller.study.stagehand import Again, Change, Stagehand
from controller.study.subject import Subject
from controller.study.trial import shown, trial
from controller.study.values import Cell, Criterion, Experiment, Figure, Result, Table

LEVELS_PX: Final = (0.1, 0.5, 1.5, 5.0)
PROJECTOR, OBJECT, CAMERA = "a projector", "the object", "the camera"
MENDED: Final = {PROJECTOR: LEVELS_PX, OBJECT: LEVELS_PX[-1:], CAMERA: LEVELS_PX[-1:]}
"""Where it is recalibrated too: a moved camera or object costs a full calibration each time."""
COSTS: Final = 0.5
"""CIEDE2000 more than before: what an unnoticed bump may cost."""
AS_GOOD: Final = 0.15
"""CIEDE2000 by which a mended stage may be worse than it was."""
CULPRITS: Final = {OBJECT: Culprit.OBJECT, CAMERA: Culprit.CAMERA}


@dataclass(frozen=True, slots=True)
class Bumped:
    """One bump. Errors are median CIEDE2000 of a photograph; None where that was not tried."""

    what: str
    moved_px: float
    unnoticed: float | None
    noticed: bool
    named: bool
    measured_px: float
    quick: float | None = None
    quick_photographs: int = 0
    full: float | None = None
    full_photographs: int = 0


def drifting(subject: Subject) -> Result:
    """Bump one thing after the other by more and more; look, mend, and photograph the same appearance."""
    hand: Stagehand = subject.parts.hand
    before = trial(subject, "undisturbed")
    quiet = hand.drift("undisturbed")
    name = subject.calibration.projectors[0].name
    found = []
    jobs = [(what, level) for what in (PROJECTOR, OBJECT, CAMERA) for level in LEVELS_PX]
    for number, (what, level) in enumerate(jobs):
        subject.advance(number / len(jobs), f"{what} by {level:g} px")
        key = f"{what.split()[1]}-{level:g}"
        hand.disturb(change_of(subject, what, name, level))
        unnoticed = None
        if what != CAMERA:
            # Who looks on does not stand where the camera stands: a moved camera changes nothing on the object.
            unnoticed = shown(subject, f"{key}-unnoticed", before.wanted, before.frames).quality.delta_e
        drift = hand.drift(key)
        mended = level in MENDED[what]
        quick = hand.quickly(key) if mended else None
        full = hand.again(key) if mended and what == PROJECTOR and level == LEVELS_PX[-1] else None
        found.append(
            Bumped(
                what, level, unnoticed, not drift.nothing, _named(drift, what, name), _measured_px(drift, what, name),
                _error(quick, f"{key}-quick"), quick.photographs if quick else 0,
                _error(full, f"{key}-full"), full.photographs if full else 0,
            )
        )  # fmt: skip
        hand.disturb()
    return Result(
        _criteria(before.quality.delta_e, quiet, found), (_table(found),), _figures(before.quality.delta_e, found), TEXT
    )


def change_of(subject: Subject, what: str, projector: str, level_px: float) -> Change:
    """A bump of so many pixels: of the projector's own, or of the camera's for camera and object."""
    if what == PROJECTOR:
        return {"what": "projector", "name": projector, "shift_px": (level_px, 0.0)}
    if what == CAMERA:
        return {"what": "camera", "shift_px": (level_px, 0.0)}
    return {"what": "object", "move_mm": (level_px * camera_pixel_mm(subject), 0.0, 0.0)}


def camera_pixel_mm(subject: Subject) -> float:
    """How far apart neighbouring camera pixels look across the object, where it faces the camera: a low percentile."""
    points = subject.geometry.points_m.astype(np.float64)
    step = np.linalg.norm(points[:, 1:] - points[:, :-1], axis=2)
    return float(1e3 * np.nanpercentile(step, 5))


def _error(again: Again | None, name: str) -> float | None:
    return None if again is None else trial(again.subject, name).quality.delta_e


def _named(drift: Drift, what: str, projector: str) -> bool:
    if what == PROJECTOR:
        return drift.culprit is Culprit.NOBODY and drift.moved == (projector,)
    return drift.culprit is CULPRITS[what]


def _measured_px(drift: Drift, what: str, projector: str) -> float:
    if what == PROJECTOR:
        (one,) = (one for one in drift.projectors if one.name == projector)
        return one.motion.rms_px
    return drift.camera.rms_px


def _criteria(before: float, quiet: Drift, found: Sequence[Bumped]) -> tuple[Criterion, ...]:
    costly = [one for one in found if one.unnoticed is not None and one.unnoticed > before + COSTS]
    missed = [one for one in costly if not one.noticed]
    large = [one for one in found if one.moved_px >= LEVELS_PX[1]]
    wrong = [one for one in large if not one.named]
    quick = [one for one in found if one.quick is not None]
    worst = max((one.quick or 0.0) - before for one in quick)
    blame = ", ".join(f"{one.what} by {one.moved_px:g} px" for one in wrong)
    return (
        Criterion("an undisturbed stage is told to be so", "yes" if quiet.nothing else "no", quiet.nothing),
        Criterion(
            f"every bump that costs more than {COSTS:g} CIEDE2000 is noticed",
            f"{len(costly) - len(missed)} of {len(costly)}", not missed,
        ),
        Criterion(
            f"from {LEVELS_PX[1]:g} px on the right one is named", f"{len(large) - len(wrong)} of {len(large)}",
            not wrong, f"Not so: {blame}." if wrong else "",
        ),
        Criterion(
            f"the quick recalibration is as good as before, within {AS_GOOD:g} CIEDE2000",
            f"at worst {worst:+.2f} to {before:.2f}", worst <= AS_GOOD,
        ),
    )  # fmt: skip


def _table(found: Sequence[Bumped]) -> Table:
    columns = (
        "moved", "by (px)", "CIEDE2000 unnoticed", "noticed", "right one named", "measured (px)",
        "CIEDE2000 after quick", "photographs", "CIEDE2000 after full", "photographs in full",
    )  # fmt: skip

    def rounded(value: float | None) -> Cell:
        return None if value is None else round(value, 2)

    rows = tuple(
        (
            one.what, one.moved_px, rounded(one.unnoticed), one.noticed, one.named, round(one.measured_px, 3),
            rounded(one.quick), one.quick_photographs or None, rounded(one.full), one.full_photographs or None,
        )
        for one in found
    )  # fmt: skip
    return Table("drift", "What bumps cost, and what mends them", columns, rows)


def _figures(before: float, found: Sequence[Bumped]) -> tuple[Figure, ...]:
    lines = []
    for what in (PROJECTOR, OBJECT):
        some = [one for one in found if one.what == what]
        lines.append(Line(f"{what}, unnoticed", [one.moved_px for one in some], [one.unnoticed or 0 for one in some]))
    mended = [one for one in found if one.what == PROJECTOR and one.quick is not None]
    lines.append(
        Line("a projector, quickly recalibrated", [one.moved_px for one in mended], [one.quick or 0 for one in mended])
    )
    return (
        Figure("drift", "Median CIEDE2000 of a photographed appearance after a bump, before and after it was mended.",
               plotted(lines, x="moved by (pixels)", y="CIEDE2000", marks={"undisturbed": ("y", before)})),
    )  # fmt: skip


TEXT = """\
Somebody bumps the stage after it was calibrated: turns a projector, shifts the object, or turns the camera, by
pixels of the projector or the camera. The same frames are photographed as if nobody had noticed; then the drift
check looks (five photographs), and a recalibration mends it, quick or in full. A moved camera changes nothing for
who looks on, so it has no error while unnoticed; it must be noticed all the same, since the next calibration step
would trust it. A shifted object's error is against a target that stays where it was. Small bumps below what the
check tells apart from noise stay unnoticed, and the first column says what they cost."""

DRIFTING = Experiment(
    name="drift",
    title="Bumps: unnoticed, detected, mended",
    paper="Beyond the paper: drift",
    shows="what a bump costs, that costly ones are noticed and named, and that a recalibration mends them.",
    scene="painted",
    run=drifting,
    cost_s=420.0,
)
