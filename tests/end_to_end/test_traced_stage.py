"""Stages that another program draws by paths (Mitsuba): surfaces light each other, and no model of ours made it."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest

from controller.core.errors import TroubleCode
from controller.run.progress import Silent
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.geometry import known_geometry, read_geometry_figures, read_shape
from controller.stage.artefacts.grade import read_troubles
from controller.stage.artefacts.solved import read_solved
from controller.stage.services.calibrate import AppearanceOrder, calibrate, make_appearances
from controller.stage.services.refine import Refinement
from controller.stage.sessions.bench import BenchProcess
from controller.stage.sessions.calibrations import finished_calibrations
from controller.stage.sessions.check import check_stage
from controller.stage.sessions.session import OwnSession
from controller.stage.steps.calibrate.gate import grade_figures
from lab.timings.calibration.indirect import GOALS, Judge, traced_stage
from lab.timings.calibration.rooms import possible_troubles
from lab.timings.tools.truth import Truth
from plugins.emulated.core.truth import read_truth

pytestmark = [pytest.mark.long, pytest.mark.timeout(1200)]
SCENE, SEED = "two-objects", 1
BLOCKS_PERCENT, FALSELY_PERCENT = 4.0, 2.0
MEASURED = 0.95


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return even_grey(tmp_path_factory.mktemp("traced"), SCENE)


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return even_grey(tmp_path_factory.mktemp("board"), "board")


def even_grey(folder: Path, scene: str) -> Path:
    """A stage that was calibrated through its devices, with an even grey that was not refined."""
    stage = traced_stage(folder, scene, "small", SEED)
    session, cancel = OwnSession(stage), threading.Event()
    with BenchProcess(stage, cancel=cancel):
        calibrate(session=session, reporter=Silent(), cancel=cancel, accept_grade=True)
        make_appearances(
            AppearanceOrder(names=["grey"], accept_grade=True, refinement=Refinement(0)),
            session=session,
            reporter=Silent(),
            cancel=cancel,
        )
    return stage


@pytest.mark.parametrize("scene", ["stage", "board"])
def test_even_grey_is_even_grey_without_a_photograph_of_it(scene: str, request: pytest.FixtureRequest) -> None:
    stage = request.getfixturevalue(scene)
    names = check_stage(stage).names
    (run,) = finished_calibrations(stage)
    solved = read_solved(run, "grey", names)
    judge = Judge(stage, Calibrated(run, names))
    found = judge.appearance(solved, [solved.frames[name] for name in names])
    median, most = GOALS[0]
    assert found["median"] <= median
    assert found["95"] <= most
    assert found["blocks %"] <= BLOCKS_PERCENT
    assert found["falsely %"] <= FALSELY_PERCENT


def test_a_flat_board_is_one_plane_and_lies_where_it_is(board: Path) -> None:
    names = check_stage(board).names
    (run,) = finished_calibrations(board)
    assert read_shape(run).shape == "plane"
    assert grade_figures(run)["grade"] == "A"
    geometry = known_geometry(run, names)
    assert geometry is not None
    board_px = np.isfinite(Truth(board).points_m()[..., 2])
    mask = Calibrated(run, names).transport.object_mask
    assert np.mean(mask[board_px]) >= MEASURED
    assert np.mean(board_px[mask]) >= MEASURED
    true = Truth(board).points_m()
    measured = mask & np.isfinite(geometry.points_m[..., 2]) & np.isfinite(true[..., 2])
    here, there = (np.linalg.norm(points[measured], axis=1) for points in (geometry.points_m, true))
    figures = read_geometry_figures(run)
    sigma = np.hypot(figures["shape_rel_sigma"], figures["scale_rel_sigma"])
    assert np.abs(here / there - 1).max() <= 3 * sigma


def test_no_trouble_is_named_that_is_not_there(stage: Path) -> None:
    (run,) = finished_calibrations(stage)
    named = {(TroubleCode(str(trouble.code)), trouble.about or None) for trouble in read_troubles(run)}
    assert named <= {one for one, level in possible_troubles(read_truth(stage)).items() if level}
