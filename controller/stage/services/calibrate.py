"""Calibrate a stage and solve appearances, each as a run; for the command line and the kiosk."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from controller.bundle.install import current
from controller.config.table import is_name
from controller.core.errors import UsageError
from controller.core.text import printable
from controller.optics.solve.engines import choose_engine
from controller.run.compiling import kernels_compiled
from controller.run.journal import Journal
from controller.run.progress import Reporter
from controller.run.runner import Context, Runner, Step
from controller.run.state_machine import Event
from controller.stage.artefacts.calibrated import Calibrated, all_views
from controller.stage.artefacts.grade import is_graded, passes
from controller.stage.artefacts.outline import keep_outline
from controller.stage.artefacts.pattern_plans import PhotographOptions, photographs_named, photographs_sentence
from controller.stage.artefacts.views import first_view, is_whole, reopen_view, view_folder, view_folders, write_view
from controller.stage.rig.ambient_light import dark_after
from controller.stage.rig.rig import Rig
from controller.stage.services.refine import Refinement, refine
from controller.stage.sessions.calibrations import (
    finished_calibration,
    finished_calibrations,
    output_sizes,
    signing_key,
    usable_calibration,
    worst_grade,
)
from controller.stage.sessions.check import Checked, check_stage
from controller.stage.sessions.run import LONGEST_RUN_S, marker
from controller.stage.sessions.session import StageSession, StageWork
from controller.stage.steps import costs
from controller.stage.steps.appearance.cluster_solve import answering_on
from controller.stage.steps.appearance.publishing import BundleTarget, publish_step
from controller.stage.steps.appearance.requests import requests_of, scene_request
from controller.stage.steps.appearance.solving import options_of, solve_steps
from controller.stage.steps.calibrate.dots import dot_steps
from controller.stage.steps.calibrate.drift import changed_lamps, swapped_views
from controller.stage.steps.calibrate.full import calibration_steps, join_geometry
from controller.stage.steps.calibrate.gate import accept, below_grade, compare_with_last, gate_step, grade_figures
from controller.stage.steps.calibrate.grade import verify_step
from controller.stage.steps.capture.camera import device_checks
from controller.stage.steps.modes import DotOptions
from hal.deadline import Cancelled, in_seconds
from hal.errors import DeviceError
from hal.notices import Level


def calibrate(
    *,
    session: StageSession,
    reporter: Reporter,
    cancel: threading.Event,
    dots: DotOptions | None = None,
    photographs: str | None = None,
    accept_grade: bool = False,
    view: str | None = None,
) -> Mapping[str, Any]:
    """Calibrate the stage, or continue an unfinished calibration; returns where the results are.

    ``view``: photograph only from this place, for the newest calibration; a view of this name is replaced once the new
    one is whole, or completed if it was not. Raises UsageError("view-unknown", "view-is-first", "not-calibrated").

    ``photographs``: which set, instead of stage.toml's; its error: see ``photographs_named``.
    """
    chosen = None if photographs is None else photographs_named(photographs)
    checked = check_stage(session.stage)
    place = None if view is None else _Place.of(checked, view)
    for name, _ in checked.stage.tables.views:
        checked.prior(name)
    last = next(iter(finished_calibrations(checked.stage.folder)), None)
    before = {} if last is None else view_folders(last)

    def steps(rig: Rig, folder: Path) -> Sequence[Step]:
        of = chosen or checked.stage.tables.calibration.photographs
        taking = PhotographOptions(of, before.get(rig.view))
        return calibrating(rig, folder, checked=checked, options=dots, photographs=taking)

    work = StageWork("calibrate", steps, dark=True, before=partial(_all_checks, checked), views=place is None,
                     place=None if place is None else (place.view, place.working))  # fmt: skip
    run = session.run(checked, work, reporter=reporter, cancel=cancel)
    if place is not None:
        place.finish()
        run, last = place.run, None
    join_geometry(run, checked.poses, checked.prior, checked.stage.tables.object.shape, reporter)
    for sentence in (*swapped_views(view_folders(run), before), *changed_lamps(run, checked.names)):
        reporter.say(sentence, Level.WARNING)
    report_grade(checked, run, last, reporter, accept_grade=accept_grade)
    return {"run": str(run), **grade_figures(run), "photographs": photographs_sentence(run, checked.names)}


def _all_checks(checked: Checked, rig: Rig) -> Sequence[Step]:
    """Of the devices, for the camera of each view. A camera that fails and is not the first ends its view alone."""
    steps = list(device_checks(rig, checked.prior(rig.view)))
    for other in rig.others:
        for step in device_checks(rig.seen_by(other), checked.prior(other.name)):
            steps.append(replace(step, id=replace(step.id, item=other.name), run=partial(_unless_absent, step.run)))
    return steps


def _unless_absent(run: Callable[[Context], Sequence[Path]], context: Context) -> Sequence[Path]:
    try:
        return run(context)
    except DeviceError as error:
        if isinstance(error, Cancelled):
            raise
        return ()


@dataclass(frozen=True, slots=True)
class _Place:
    """A view that is photographed alone. ``working``: where it is until it is whole."""

    run: Path
    view: str
    number: int
    working: Path

    @classmethod
    def of(cls, checked: Checked, view: str) -> _Place:
        run = finished_calibration(checked.stage.folder)
        names, there = [name for name, _ in checked.stage.tables.views], view_folders(run)
        if view == first_view(run):
            raise UsageError(
                "view-is-first",
                what=f"The view {view} is the one that the calibration {run.name} begins with.",
                remedy="Run `velatura calibrate` without --view to photograph it again with all others.",
            )
        if view not in names and (len(names) > 1 or not is_name(view)):
            raise UsageError(
                "view-unknown",
                what=f"The stage has no camera {printable(view)[:64]!r}.",
                remedy=f"Choose one of {', '.join(names)}, or add a table [[cameras]] with this name.",
            )
        number = names.index(view) if view in names else len(names) + len(there)
        folder = view_folder(run, view)
        return cls(run, view, number, folder.with_name(f".{folder.name}.new") if is_whole(folder) else folder)

    def finish(self) -> None:
        """Put the whole view in its place."""
        folder = view_folder(self.run, self.view)
        if self.working != folder:
            reopen_view(folder)
            shutil.rmtree(folder)
            self.working.rename(folder)
        write_view(folder, self.view, self.number, time.strftime("%Y%m%d-%H%M%S"))


def calibrating(
    rig: Rig,
    run: Path,
    *,
    checked: Checked,
    options: DotOptions | None = None,
    photographs: PhotographOptions | None = None,
    calibrated: Calibrated | None = None,
) -> Sequence[Step]:
    """The calibration's steps between their state markers; grading is the last.

    ``photographs``: stage.toml's if omitted, without a calibration from before
    ``calibrated``: what reads the calibration of ``run``, where the caller needs it too.
    """
    longest_s = checked.stage.tables.capture.longest_exposure_s
    if rig.view == checked.stage.tables.views[0][0]:
        # It is drawn in the first camera's picture.
        keep_outline(run, checked.stage.tables.object.outline)
    scale = costs.scale(projector.size_px for projector in rig.projectors)
    taking = photographs or PhotographOptions(checked.stage.tables.calibration.photographs)
    shape = checked.stage.tables.object.shape
    prior = checked.prior(rig.view)
    steps = [*calibration_steps(rig, prior, longest_exposure_s=longest_s, options=taking, shape=shape),
             *dot_steps(rig, options or DotOptions(), longest_exposure_s=longest_s)]  # fmt: skip
    own = calibrated if calibrated is not None and rig.is_first else Calibrated(run, checked.names)
    return [
        marker("calibrating", "Calibrating", enter=Event.RECALIBRATE),
        *steps,
        verify_step(own, [step.id for step in steps], scale),
        *dark_after(rig.ambient_limit, rig.display),
        marker("calibrated", "Calibrated", leave=Event.CALIBRATED),
    ]


@dataclass(frozen=True, slots=True)
class AppearanceOrder:
    """Which appearances to make, how they are solved, and where.

    Parameters
    ----------
    names : of stage.toml; none: all, unless there are scenes
    scenes : Blender scenes to render in addition to ``names``, or only these if no names are given
    refinement : how photographs then correct them; None keeps refined frames
    device : what solves, instead of stage.toml's
    scheduler : a Dask cluster that solves the appearances; None: that of the stage's house, if it has workers now
    accept_grade : publish with any calibration grade
    """

    names: Sequence[str] = ()
    scenes: Sequence[str] = ()
    refinement: Refinement | None = None
    device: str | None = None
    scheduler: str | None = None
    accept_grade: bool = False


def make_appearances(
    order: AppearanceOrder, *, session: StageSession, reporter: Reporter, cancel: threading.Event
) -> Mapping[str, Any]:
    """Solve appearances of stage.toml with the latest calibration, and install them as the stage's bundle.

    Without a refinement it uses no device: the projectors may be off, or playing.
    Raises what ``choose_engine``, ``usable_calibration``, ``requests_of``, ``answering_on`` and the steps raise.
    """
    checked = check_stage(session.stage)
    folder = checked.stage.folder
    solve = checked.stage.tables.solve
    engine = choose_engine(solve.device if order.device is None else order.device, reporter.say)
    with session.locked():
        run = usable_calibration(checked, reporter, accept_grade=order.accept_grade)
        calibrated = all_views(run, checked.names, engine)
        requests = requests_of(checked.stage, calibrated, order.names) if order.names or not order.scenes else []
        requests += [scene_request(calibrated, scene, folder=Path.cwd()) for scene in order.scenes]
        scale = costs.scale(size for _, size in output_sizes(checked).values())
        with (
            kernels_compiled(reporter) as compiled,
            answering_on(order.scheduler, calibrated, requests, folder) as answering,
            Journal(run) as journal,
        ):
            steps = [
                *compiled,
                *([] if is_graded(run) else [verify_step(calibrated.first, (), scale)]),
                gate_step(worst_grade(checked), accepted=order.accept_grade, reporter=reporter),
                *solve_steps(calibrated, requests, options_of(solve), (), scale, answering=answering),
            ]
            names = [request.name for request in requests]
            publish = publishing(checked, calibrated.first, names)
            whole = [*steps, publish] if order.refinement is None else steps
            Runner(whole, journal, reporter=reporter).run("appearance", deadline=in_seconds(LONGEST_RUN_S, cancel))
    refined: Mapping[str, Any] = {}
    if order.refinement is not None:
        titles = {request.name: request.title for request in requests}
        refined = refine(session, checked, calibrated, titles, order.refinement, reporter=reporter, cancel=cancel)
        with session.locked(), Journal(run) as journal:
            Runner([publish], journal, reporter=reporter).run("appearance", deadline=in_seconds(LONGEST_RUN_S, cancel))
    return {"bundle": str(current(folder / "bundles")), "appearances": ", ".join(names), **refined}


def publishing(checked: Checked, calibrated: Calibrated, names: Sequence[str]) -> Step:
    """The step that makes these appearances of the run of ``calibrated`` the stage's signed bundle."""
    stage = checked.stage
    name, run = stage.tables.stage.name, calibrated.folder.name
    target = BundleTarget(stage.folder, name, run, output_sizes(checked), signing_key(checked))
    return publish_step(target, names, calibrated=calibrated)


def report_grade(checked: Checked, run: Path, last: Path | None, reporter: Reporter, *, accept_grade: bool) -> None:
    """After a calibration: warn if it is worse than the previous one, or not good enough to publish."""
    worst = worst_grade(checked)
    compare_with_last(run, last, reporter)
    if accept_grade:
        accept(run, reporter, worst)
    if not passes(run, worst):
        error = below_grade(run, worst)
        reporter.say(f"{error.what} {error.remedy}", Level.WARNING)
