"""One projector beside several: both comparisons, and what they leave out."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from controller.core.arrays import FloatImage
from controller.optics.calibrate.values import Calibration
from controller.optics.solve.appearance import exposed_for_one
from controller.optics.solve.result.metrics import Comparison, compare
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.published import Dimmed, write_photograph
from controller.stage.artefacts.solved import RequestedTarget, Solved
from controller.stage.report.one_projector import OneProjector, as_figures, as_rows, goals, one_projector
from tests.lab.study.array_stage import CAMERA, array_subject

OURS, THEIRS = 1.0, 0.25


def grey(level: float) -> FloatImage:
    return np.full((*CAMERA, 3), level, np.float32)


def found(run: Path, *, with_dimmed: bool = True) -> tuple[OneProjector, Comparison]:
    """Ours is 2 % too bright; one projector half as bright as ours should be, and 6 % too bright at its own exposure.

    One projector reaches the left half alone.
    """
    calibration: Calibration = array_subject().calibration
    mask = calibration.object_mask
    asked = RequestedTarget(grey(0.5), mask, np.ones_like(mask))
    solved = Solved({}, {}, asked.target, mask, {"exposure": OURS}, asked)
    write_photograph(run, StepKind.TRADITIONAL, "grey", grey(0.25))
    left = mask & (np.arange(CAMERA[1]) < CAMERA[1] // 2)
    if with_dimmed:
        Dimmed(grey(THEIRS * 0.53), grey(THEIRS * 0.5), left, THEIRS).write(run, "grey")
    ours = compare(grey(0.51), asked.target, calibration.camera_to_xyz, OURS, mask)
    return one_projector(run, "grey", calibration, solved, grey(0.51), mask), ours


def test_both_exposures_are_compared_and_the_second_only_where_both_reach(tmp_path: Path) -> None:
    one, ours = found(tmp_path)
    figures = as_figures(one, ours)
    assert figures["times_better"] > 10
    assert 2 < figures["times_better_dimmed"] < 4
    dimmed = figures["dimmed"]
    assert dimmed["exposure"] == pytest.approx(0.25)
    assert dimmed["left_out_share"] == pytest.approx(0.5, abs=0.01)
    assert dimmed["pixels"]["in_reach"]["left_out_share"] == pytest.approx(0.5, abs=0.01)
    assert dimmed["pixels"]["lit"]["left_out_share"] == 0
    same, own = as_rows(one, ours)
    assert f"ours {figures['times_better']:.1f} times nearer" in same[1]
    assert f"{figures['times_better_dimmed']:.1f} times nearer, at 0.25 of our light" in own[1]
    assert "(50.0 % left out)" in own[1]


def test_each_goal_is_of_the_appearance_that_gains_least_and_can_be_missed(tmp_path: Path) -> None:
    one, ours = found(tmp_path)
    assert one.dimmed is not None
    behind = dataclasses.replace(one, dimmed=dataclasses.replace(one.dimmed, theirs=ours))
    same, own = goals({"grey": (one, ours), "behind": (behind, ours)})
    assert same.holds
    assert own.holds is False
    assert own.note == "behind"
    assert own.value == "1.0 times"


def test_a_run_from_before_that_photograph_has_one_comparison(tmp_path: Path) -> None:
    one, ours = found(tmp_path, with_dimmed=False)
    assert as_figures(one, ours)["times_better_dimmed"] is None
    assert len(as_rows(one, ours)) == 1
    assert len(goals({"grey": (one, ours)})) == 1


def test_one_projector_is_exposed_by_the_same_rule_as_all() -> None:
    subject = array_subject()
    picture = np.where(subject.mask[..., None], grey(0.8), grey(0))
    found = exposed_for_one(subject.calibration, picture, 0, share=0.95)
    lit = subject.transport.lit[0] & subject.mask
    assert 0.9 < found.possible.reachable[lit].mean() <= 1
    brighter = exposed_for_one(subject.calibration, picture, 2, share=0.95)
    assert brighter.exposure > 1.1 * found.exposure
