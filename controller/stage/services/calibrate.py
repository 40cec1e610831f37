"""Calibrate a stage and solve appearances, each as a run; for the command line and the kiosk."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from controller.bundle.install import current
from controller.optics.solve.engines import choose_engine
from controller.run.compiling import kernels_compiled
from controller.run.journal import Journal
from controller.run.progress import Reporter
from controller.run.runner import Runner, Step
from controller.run.state_machine import Event
from controller.stage.artefacts.calibrated import Calibrated, all_views
from controller.stage.artefacts.grade import is_graded, passes
from controller.stage.artefacts.outline import keep_outline
from controller.stage.artefacts.pattern_plans import PhotographOptions, photographs_named, photographs_sentence
from controller.stage.rig.ambient_light import dark_after
from controller.stage.rig.rig import Rig
from controller.stage.services.refine import Refinement, refine
from controller.stage.sessions.calibrations import (
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
from controller.stage.steps.appearance.solving import base_choice, options_of, solve_steps
from controller.stage.steps.calibrate.dots import dot_steps
from controller.stage.steps.calibrate.full import calibration_steps, join_geometry
from controller.stage.steps.calibrate.gate import accept, below_grade, compare_with_last, gate_step, grade_figures
from controller.stage.steps.calibrate.grade import verify_step
from controller.stage.steps.capture.camera import device_checks
from controller.stage.steps.modes import DotOptions, dot_options
from hal.deadline import in_seconds
from hal.notices import Level


def calibrate(
    *,
    session: StageSession,
    reporter: Reporter,
    cancel: threading.Event,
    mode: str = "fast",
    dot_spacing: str | None = None,
    photographs: str | None = None,
    accept_grade: bool = False,
) -> Mapping[str, Any]:
    """Calibrate the stage, or continue an unfinished calibration; returns where the results are.

    ``mode``, ``dot_spacing`` and their errors: see ``steps.modes.dot_options``. ``photographs``: which set, instead
    of stage.toml's; its error: see ``photographs_named``.
    """
    options = dot_options(mode, dot_spacing)
    chosen = None if photographs is None else photographs_named(photographs)
    checked = check_stage(session.stage)
    prior = checked.prior
    last = next(iter(finished_calibrations(checked.stage.folder)), None)
    taking = PhotographOptions(chosen or checked.stage.tables.calibration.photographs, last)
    run = session.run(
        checked,
        StageWork(
            "calibrate",
            lambda rig, run: calibrating(rig, run, checked=checked, options=options, photographs=taking),
            dark=True,
            before=lambda rig: device_checks(rig, prior),
        ),
        reporter=reporter,
        cancel=cancel,
    )
    join_geometry(run, checked.names, lambda view: prior, checked.stage.tables.object.shape, reporter)
    report_grade(checked, run, last, reporter, accept_grade=accept_grade)
    return {"run": str(run), **grade_figures(run), "photographs": photographs_sentence(run, checked.names)}


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
    keep_outline(run, checked.stage.tables.object.outline)
    scale = costs.scale(projector.size_px for projector in rig.projectors)
    taking = photographs or PhotographOptions(checked.stage.tables.calibration.photographs)
    shape = checked.stage.tables.object.shape
    steps = [*calibration_steps(rig, checked.prior, longest_exposure_s=longest_s, options=taking, shape=shape),
             *dot_steps(rig, options or DotOptions(), longest_exposure_s=longest_s)]  # fmt: skip
    return [
        marker("calibrating", "Calibrating", enter=Event.RECALIBRATE),
        *steps,
        verify_step(calibrated or Calibrated(run, checked.names), [step.id for step in steps], scale),
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
    base : the base image instead of stage.toml's
    refinement : how photographs then correct them; None keeps refined frames
    device : what solves, instead of stage.toml's
    scheduler : a Dask cluster that solves the appearances
    accept_grade : publish with any calibration grade
    """

    names: Sequence[str] = ()
    scenes: Sequence[str] = ()
    base: str | None = None
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
    chosen = None if order.base is None else base_choice(order.base)
    checked = check_stage(session.stage)
    folder = checked.stage.folder
    solve = checked.stage.tables.solve
    engine = choose_engine(solve.device if order.device is None else order.device, reporter.say, solve.method)
    with session.locked():
        run = usable_calibration(checked, reporter, accept_grade=order.accept_grade)
        calibrated = all_views(run, checked.names, engine)
        requests = requests_of(checked.stage, calibrated, order.names) if order.names or not order.scenes else []
        requests += [scene_request(calibrated, scene, folder=Path.cwd()) for scene in order.scenes]
        options = options_of(solve) if chosen is None else replace(options_of(solve), base=chosen)
        scale = costs.scale(size for _, size in output_sizes(checked).values())
        with (
            kernels_compiled(reporter) as compiled,
            answering_on(order.scheduler, calibrated, requests) as answering,
            Journal(run) as journal,
        ):
            steps = [
                *compiled,
                *([] if is_graded(run) else [verify_step(calibrated.first, (), scale)]),
                gate_step(worst_grade(checked), accepted=order.accept_grade, reporter=reporter),
                *solve_steps(calibrated, requests, options, (), scale, answering=answering),
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
