"""Keeps a calibration up to date: the drift check, and recalibration of only what has changed."""

from __future__ import annotations

import os
import shutil
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from controller.core.errors import UsageError
from controller.run.journal import Journal
from controller.run.progress import Reporter
from controller.run.runner import Context, Step
from controller.run.state_machine import Event
from controller.run.step_id import StepId
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.drift import read_drift_figures
from controller.stage.artefacts.grade import passes
from controller.stage.artefacts.kinds import CALIBRATED, StepKind
from controller.stage.artefacts.names import json_path, read_json
from controller.stage.artefacts.outline import keep_outline
from controller.stage.artefacts.pattern_plans import PhotographOptions, photographs_named
from controller.stage.artefacts.projectors import mode_of
from controller.stage.artefacts.views import view_folder, view_folders
from controller.stage.rig.ambient_light import dark_after
from controller.stage.rig.rig import Rig
from controller.stage.sessions.calibrations import finished_calibration, worst_grade
from controller.stage.sessions.check import Checked, check_stage
from controller.stage.sessions.run import marker
from controller.stage.sessions.session import StageSession, StageWork
from controller.stage.steps.calibrate.dots import dot_steps
from controller.stage.steps.calibrate.drift import changed_lamps, drift_steps, skew_step, swapped_views
from controller.stage.steps.calibrate.full import calibration_steps, join_geometry
from controller.stage.steps.calibrate.gate import accept, below_grade, compare_with_last, grade_figures
from controller.stage.steps.calibrate.quick import one_projector_steps, quick_steps
from controller.stage.steps.modes import MODES, CalibrationMode, DotOptions
from hal.notices import Level

CHECKS = (StepKind.DRIFT_PHOTOGRAPHS, StepKind.VERIFICATION_PHOTOGRAPHS)
"""The photographs of the previous check and of the grade."""


def check_drift(
    *, session: StageSession, details: bool, reporter: Reporter, cancel: threading.Event, skew: bool | None = False
) -> Mapping[str, Any]:
    """Photograph the stage N + 2 times and find what has changed since its calibration; ``details``: all figures.

    ``skew``: also how far apart the outputs of several computers or screens change; None: if there are several.
    Raises UsageError("not-calibrated", "skew-one-player"), and what the devices raise.
    """
    checked = check_stage(session.stage)
    last = finished_calibration(checked.stage.folder)
    lit = {projector.output for projector in checked.stage.tables.projectors}
    places = {one.name: one.elsewhere for one in checked.stage.tables.display.outputs if one.name in lit}
    if skew and len(set(places.values())) < 2:
        raise UsageError(
            "skew-one-player", what="One player shows all of these outputs, so they change together.",
            remedy="Leave out --skew: it is for outputs of several computers or X screens.",
        )  # fmt: skip
    skew = skew is not False and len(set(places.values())) > 1

    def steps(rig: Rig, _: Path) -> Sequence[Step]:
        calibrated, longest_s = _calibrated(checked, last, rig), checked.stage.tables.capture.longest_exposure_s
        here = min(places, key=lambda name: places[name] != "")
        also = [skew_step(rig, calibrated, here, longest_s)] if skew and rig.is_first else []
        return [*drift_steps(rig, calibrated, longest_exposure_s=longest_s), *also]

    run = session.run(checked, StageWork("drift", steps, views=True), reporter=reporter, cancel=cancel)
    content = read_drift_figures(run)
    folders = view_folders(run)
    for name, folder in folders.items():
        of_view = read_drift_figures(folder)
        for sentence in of_view["sentences"]:
            level = Level.INFO if of_view["advice"] == "nothing" else Level.WARNING
            reporter.say(sentence if len(folders) == 1 else f"View {name}: {sentence}", level)
    for sentence in swapped_views(folders, view_folders(last)):
        reporter.say(sentence, Level.WARNING)
    content |= {"skew": read_json(json_path(run, StepKind.SKEW))} if skew else {}
    with Journal(run) as journal:
        content["seconds"] = journal.steps()[StepId(StepKind.DRIFT_PHOTOGRAPHS)]
    return {"run": str(run), **(content if details else {"advice": content["advice"]})}


def recalibrate(
    *,
    session: StageSession,
    reporter: Reporter,
    cancel: threading.Event,
    accept_grade: bool = False,
    projector: str | None = None,
    photographs: str | None = None,
) -> Mapping[str, Any]:
    """Bring the last calibration up to date, repeating only what has changed; continues an unfinished run.

    ``photographs``: which set of what is photographed again, instead of stage.toml's; its error: ``photographs_named``.
    ``projector``: measure only this one again, completely. The others get one photograph each, for the grade.
    Raises UsageError("not-calibrated", "projector-unknown"), CalibrationError("projector-dark"),
    CalibrationError("calibration-below-grade") for a result that may not replace the last calibration, and what the
    devices raise.
    """
    chosen = None if photographs is None else photographs_named(photographs)
    checked = check_stage(session.stage)
    check_name(checked, projector)
    last = finished_calibration(checked.stage.folder)

    def steps(rig: Rig, run: Path) -> Sequence[Step]:
        longest_s, calibrated = checked.stage.tables.capture.longest_exposure_s, _calibrated(checked, last, rig)
        if rig.is_first:
            keep_outline(run, checked.stage.tables.object.outline)
        mode: CalibrationMode = next((one for one in MODES if one == mode_of(calibrated.folder)), "fast")
        taking = PhotographOptions(chosen or checked.stage.tables.calibration.photographs, calibrated.folder)
        shape = checked.stage.tables.object.shape
        prior = checked.prior(rig.view)
        full = [*calibration_steps(rig, prior, longest_exposure_s=longest_s, options=taking, shape=shape),
                *dot_steps(rig, DotOptions(mode, None), longest_exposure_s=longest_s)]  # fmt: skip
        if projector is None:
            repeated = quick_steps(rig, run, calibrated, full, longest_exposure_s=longest_s)
        else:
            repeated = one_projector_steps(rig, run, calibrated, full, projector, longest_exposure_s=longest_s)
        return [
            marker("calibrating", "Calibrating", enter=Event.RECALIBRATE),
            *repeated,
            *dark_after(rig.ambient_limit, rig.display),
            _take_over_step(worst_grade(checked), reporter, accept_grade=accept_grade),
            marker("recalibrated", "Recalibrated", leave=Event.CALIBRATED),
        ]

    name = "recalibrate" if projector is None else "projector"
    run = session.run(checked, StageWork(name, steps, dark=True, views=True), reporter=reporter, cancel=cancel)
    _keep_views(run, last, reporter)
    join_geometry(run, checked.poses, checked.prior, checked.stage.tables.object.shape, reporter)
    for sentence in changed_lamps(run, checked.names):
        reporter.say(sentence, Level.WARNING)
    compare_with_last(run, last, reporter)
    if not passes(run, worst_grade(checked)):
        raise below_grade(run, worst_grade(checked))
    advice = "projector" if projector is not None else read_drift_figures(run)["advice"]
    return {"run": str(run), **grade_figures(run), "advice": advice, **_effort(run)}


def _calibrated(checked: Checked, last: Path, rig: Rig) -> Calibrated:
    """The last calibration of the rig's view. Raises UsageError("view-not-calibrated")."""
    folders = view_folders(last)
    if rig.view in folders or rig.is_first:
        return Calibrated(folders.get(rig.view, last), checked.names)
    raise UsageError(
        "view-not-calibrated", what=f"The calibration {last.name} has no view {rig.view}.",
        remedy=f"Run `velatura calibrate STAGE --view {rig.view}` to add it.",
    )  # fmt: skip


def _keep_views(run: Path, last: Path, reporter: Reporter) -> None:
    """Take over the last calibration's views that were not photographed now, where nothing moved."""
    drift = json_path(run, StepKind.DRIFT)
    moved = drift.exists() and any(row["moved"] for row in read_drift_figures(run)["projectors"].values())
    moved |= drift.exists() and read_drift_figures(run)["advice"] == "full"
    for name, folder in view_folders(last).items():
        if name in view_folders(run):
            continue
        if moved:
            reporter.say(f"View {name} is lost: something has moved, and it was not photographed.", Level.WARNING)
            continue
        shutil.rmtree(view_folder(run, name), ignore_errors=True)
        shutil.copytree(folder, view_folder(run, name), copy_function=os.link)
        reporter.say(f"View {name} was not photographed: it stays as it was.", Level.WARNING)


def _effort(run: Path) -> dict[str, float]:
    """How many photographs were taken, and the seconds of the check and of the grade."""
    with Journal(run) as journal:
        seconds = sum(value for step, value in journal.steps().items() if step.kind in CHECKS)
        return {"photographs": journal.shot_count(), "check_and_grade_seconds": seconds}


def check_name(checked: Checked, projector: str | None) -> None:
    """Raises UsageError("projector-unknown"), before a lamp is struck."""
    if projector is not None and projector not in checked.names:
        raise UsageError("projector-unknown", what=f"The stage has no projector {projector[:64]!r}.",
                         remedy=f"Choose one of {', '.join(checked.names)}.")  # fmt: skip


def _take_over_step(worst: float, reporter: Reporter, *, accept_grade: bool) -> Step:
    """Only a result with a sufficient grade counts as finished and replaces the last calibration."""

    def run(context: Context) -> Sequence[Path]:
        if accept_grade:
            accept(context.folder, reporter, worst)
        if passes(context.folder, worst):
            context.journal.complete(CALIBRATED, {}, (), began_at_s=time.time())
        return ()

    return Step(StepId("take-over"), run, title="Comparing the grade with the limit", weight=0.01, always=True)
