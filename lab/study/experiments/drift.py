"""Beyond the paper: what an unnoticed bump costs, and how the drift check and recalibration help."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from controller.optics.calibrate.verify.drift import Drift, DriftCause
from lab.study.output.drawing import Line, plotted
from lab.study.subject.measuring import SET_COLUMNS, set_cells
from lab.study.subject.subject import BenchChange, Recalibration, StageControl, Subject
from lab.study.subject.trial import Trial, photograph_frames, run_trial
from lab.study.values import Cell, Criterion, Experiment, Figure, Result, ResultTable

LEVELS_PX: Final = (0.1, 0.5, 1.5, 5.0)
PROJECTOR, OBJECT, CAMERA = "a projector", "the object", "the camera"
LARGEST_UNNOTICED: Final = (0.5, 1.0)
"""CIEDE2000 more than before, median and 95 %: the largest acceptable cost of an unnoticed bump."""
AS_GOOD: Final = (0.15, 0.5)
"""CIEDE2000 by which a recalibrated stage may be worse than before, median and 95 %."""
CULPRITS: Final = {OBJECT: DriftCause.OBJECT, CAMERA: DriftCause.CAMERA}


Error = tuple[float, float]
"""CIEDE2000 of a photograph: the median, and 95 %."""


@dataclass(frozen=True, slots=True)
class BumpResult:
    """One bump. Errors are None where that was not tried."""

    what: str
    moved_px: float
    unnoticed: Error | None
    noticed: bool
    named: bool
    measured_px: float
    quick: Error | None = None
    quick_photographs: int = 0
    full: Error | None = None
    full_photographs: int = 0
    cells: tuple[str, ...] = ("",) * len(SET_COLUMNS)


def drifting(subject: Subject) -> Result:
    """Bump one part after the other by growing amounts; check, recalibrate, and photograph the same appearance."""
    hand: StageControl = subject.parts.hand
    before = run_trial(subject, "undisturbed")
    quiet = hand.drift("undisturbed")
    name = subject.calibration.projectors[0].name
    bumps = []
    jobs = [(what, level) for what in (PROJECTOR, OBJECT, CAMERA) for level in LEVELS_PX]
    for number, (what, level) in enumerate(jobs):
        subject.advance(number / len(jobs), f"{what} by {level:g} px")
        key = f"{what.split()[1]}-{level:g}"
        hand.disturb(change_of(subject, what, name, level))
        seen: Trial | None = None
        if what != CAMERA:
            # Who looks on does not stand where the camera stands: a moved camera changes nothing on the object.
            seen = photograph_frames(subject, f"{key}-unnoticed", before.wanted, before.frames)
        drift = hand.drift(key)
        quick = None if drift.nothing else hand.quickly(key)
        full = hand.again(key) if what == PROJECTOR and level == LEVELS_PX[-1] else None
        bumps.append(
            BumpResult(
                what=what,
                moved_px=level,
                unnoticed=None if seen is None else _error_of(seen),
                noticed=not drift.nothing,
                named=_named(drift, what, name),
                measured_px=_measured_px(drift, what, name),
                quick=_error(quick, f"{key}-quick"),
                quick_photographs=quick.photographs if quick else 0,
                full=_error(full, f"{key}-full"),
                full_photographs=full.photographs if full else 0,
                cells=set_cells({} if seen is None else seen.quality.pixels, before.wanted),
            )
        )
        hand.disturb()
    undisturbed = _error_of(before)
    return Result(_criteria(undisturbed, quiet, bumps), (_table(bumps),), _figures(undisturbed, bumps), TEXT)


def change_of(subject: Subject, what: str, projector: str, level_px: float) -> BenchChange:
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


def _error_of(trial: Trial) -> Error:
    return trial.quality.delta_e, trial.quality.delta_e_p95


def _error(again: Recalibration | None, name: str) -> Error | None:
    return None if again is None else _error_of(run_trial(again.subject, name))


def _worse(error: Error, before: Error, by: Error) -> bool:
    """Whether either of the two is by more than that above what it was."""
    return any(now > then + most for now, then, most in zip(error, before, by, strict=True))


def _named(drift: Drift, what: str, projector: str) -> bool:
    if what == PROJECTOR:
        return drift.culprit is DriftCause.NONE and drift.moved == (projector,)
    return drift.culprit is CULPRITS[what]


def _measured_px(drift: Drift, what: str, projector: str) -> float:
    if what == PROJECTOR:
        (moved,) = (part for part in drift.projectors if part.name == projector)
        return moved.motion.rms_px
    return drift.camera.rms_px


def _criteria(before: Error, quiet: Drift, bumps: Sequence[BumpResult]) -> tuple[Criterion, ...]:
    costly = [
        bump for bump in bumps if bump.unnoticed is not None and _worse(bump.unnoticed, before, LARGEST_UNNOTICED)
    ]
    missed = [bump for bump in costly if not bump.noticed]
    large = [bump for bump in bumps if bump.moved_px >= LEVELS_PX[1]]
    wrong = [bump for bump in large if not bump.named]
    quick = [bump.quick for bump in bumps if bump.quick is not None]
    noticed = sum(bump.noticed for bump in bumps)
    median, most = (max((error[place] for error in quick), default=math.inf) - before[place] for place in (0, 1))
    failures = ", ".join(f"{bump.what} by {bump.moved_px:g} px" for bump in wrong)
    return (
        Criterion("an undisturbed stage is reported as undisturbed", "yes" if quiet.nothing else "no", quiet.nothing),
        Criterion(
            f"every bump that costs more than {LARGEST_UNNOTICED[0]:g} CIEDE2000 in the median, or"
            f" {LARGEST_UNNOTICED[1]:g} in 95 %, is noticed",
            f"{len(costly) - len(missed)} of {len(costly)}", bool(costly) and not missed,
            "" if costly else "No bump cost so much: nothing was shown.",
        ),
        Criterion(
            f"from {LEVELS_PX[1]:g} px on the right one is named", f"{len(large) - len(wrong)} of {len(large)}",
            not wrong, f"Failed: {failures}." if wrong else "",
        ),
        Criterion(
            f"the quick recalibration is as good as before, within {AS_GOOD[0]:g} CIEDE2000 in the median, and"
            f" {AS_GOOD[1]:g} in 95 %",
            f"after {len(quick)} of {noticed} noticed bumps,"
            f" at worst {median:+.2f} to {before[0]:.2f}, and {most:+.2f} to {before[1]:.2f}",
            bool(quick) and not any(_worse(error, before, AS_GOOD) for error in quick),
        ),
    )  # fmt: skip


def _table(bumps: Sequence[BumpResult]) -> ResultTable:
    columns = (
        "moved", "by (px)", "CIEDE2000 unnoticed", "95 %, unnoticed", "noticed", "right one named", "measured (px)",
        "CIEDE2000 after quick", "95 %, after quick", "photographs", "CIEDE2000 after full", "95 %, after full",
        "photographs in full", *SET_COLUMNS,
    )  # fmt: skip

    def rounded(error: Error | None) -> tuple[Cell, Cell]:
        return (None, None) if error is None else (round(error[0], 2), round(error[1], 2))

    rows = tuple(
        (
            bump.what, bump.moved_px, *rounded(bump.unnoticed), bump.noticed, bump.named, round(bump.measured_px, 3),
            *rounded(bump.quick), bump.quick_photographs or None, *rounded(bump.full), bump.full_photographs or None,
            *bump.cells,
        )
        for bump in bumps
    )  # fmt: skip
    return ResultTable("drift", "The cost of bumps before and after recalibration", columns, rows)


def _figures(before: Error, bumps: Sequence[BumpResult]) -> tuple[Figure, ...]:
    figures = []
    for place, (name, title) in enumerate({"median": "Median CIEDE2000", "most": "CIEDE2000 of 95 %"}.items()):
        unnoticed, quick = ({bump: error[place] for bump in bumps if (error := getattr(bump, way)) is not None}
                            for way in ("unnoticed", "quick"))  # fmt: skip
        lines = [_line(f"{what}, unnoticed", what, unnoticed) for what in (PROJECTOR, OBJECT)]
        lines.append(_line("a projector, quickly recalibrated", PROJECTOR, quick))
        picture = plotted(lines, x="moved by (pixels)", y=title, marks={"undisturbed": ("y", before[place])},
                          y_range=(0, None))  # fmt: skip
        caption = f"{title} of a photographed appearance after a bump, before and after recalibration."
        figures.append(Figure(name, caption, picture))
    return tuple(figures)


def _line(name: str, what: str, errors: Mapping[BumpResult, float]) -> Line:
    some = {bump.moved_px: error for bump, error in errors.items() if bump.what == what}
    return Line(name, list(some), list(some.values()))


TEXT = """\
The stage is bumped after it was calibrated: a projector turns, the object shifts, or the camera turns, by a number
of projector or camera pixels. The same frames are photographed before the bump is noticed. Then the drift check runs
(five photographs), and a quick or full recalibration corrects the stage. A moved camera changes nothing for the
audience, so it has no error while unnoticed. It must be noticed anyway, because the next calibration step would trust
it. The error of a shifted object is measured against a target that stays in place. Bumps too small to be separated
from noise stay unnoticed, and the first column shows their cost."""

DRIFTING = Experiment(
    name="drift",
    title="Bumps: unnoticed, detected, corrected",
    paper="Beyond the paper: drift",
    shows="the cost of a bump, that costly ones are noticed and named, and that a recalibration corrects them.",
    scene="painted",
    run=drifting,
    cost_s=420.0,
)
