"""The steps that solve use the engine that the run's calibration was opened with."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from controller.config.models import SolveTable
from controller.core.arrays import Mask
from controller.optics.solve.bounded.engine import IterationControl, Processor
from controller.optics.solve.bounded.equations import Solution, SolveInput
from controller.optics.solve.request import AppearanceResult, SolveOptions
from controller.optics.solve.targets.values import Target
from controller.run.journal import Journal
from controller.run.progress import Silent
from controller.run.runner import Runner
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.outline import keep_outline
from controller.stage.steps.appearance.solving import AppearanceRequest, options_of, solve_steps
from hal.deadline import in_seconds
from hal.notices import Level
from lab.timings.tools.synthetic import synthetic_target, write_synthetic_run

CAMERA = (36, 50)


class Watched(Processor):
    """The processor, with a list of what it did."""

    def __init__(self) -> None:
        self.did: list[str] = []

    def solve(self, given: SolveInput, control: IterationControl) -> Solution:
        self.did.append("solve")
        return super().solve(given, control)


def test_the_base_and_every_appearance_are_made_by_it(tmp_path: Path) -> None:
    names = write_synthetic_run(tmp_path, projector=(14, 18), camera=CAMERA)
    engine = Watched()
    calibrated = Calibrated(tmp_path, names, engine)
    picture = Target(0.5 * synthetic_target(CAMERA), np.ones(CAMERA, np.bool_))
    request = AppearanceRequest("one", "One", lambda: picture, {})
    for share, expected in ((0.9, ["solve", "solve"]), (0.8, ["solve", "solve", "solve"])):
        steps = solve_steps(calibrated, [request], SolveOptions(share, 0.001), ())
        with Journal(tmp_path) as journal:
            Runner(steps, journal, reporter=Silent()).run("appearance", deadline=in_seconds(60))
        # the base is kept: it is the same for both
        assert engine.did == expected


def test_an_outline_that_was_drawn_says_what_the_object_is_and_what_was_solved_for_another_is_solved_again(
    tmp_path: Path,
) -> None:
    names = write_synthetic_run(tmp_path, projector=(14, 18), camera=CAMERA)
    request = AppearanceRequest(
        "grey", "Grey", lambda: Target(0.5 * synthetic_target(CAMERA), np.ones(CAMERA, np.bool_)), {}
    )

    def solved() -> tuple[Mask, list[str]]:
        engine = Watched()
        calibrated = Calibrated(tmp_path, names, engine)
        steps = solve_steps(calibrated, [request], SolveOptions(0.9, 0.001), ())
        with Journal(tmp_path) as journal:
            Runner(steps, journal, reporter=Silent()).run("appearance", deadline=in_seconds(60))
        return calibrated.calibration.object_mask, engine.did

    whole, _ = solved()
    columns = CAMERA[1]
    left = np.arange(columns)[None, :] < columns // 2
    keep_outline(tmp_path, [[(0, 0), (0.5, 0), (0.5, 1), (0, 1)]])
    drawn, did = solved()
    assert did == ["solve", "solve"]
    assert not drawn[:, columns // 2 + 1 :].any()
    assert drawn[:, : columns // 2].sum() == (whole & left).sum() > 0
    assert solved()[1] == [], "as it was"
    keep_outline(tmp_path, [])
    again, _ = solved()
    assert (again == whole).all()


class Said(Silent):
    def __init__(self) -> None:
        self.lines: list[str] = []

    def say(self, text: str, level: Level = Level.INFO) -> None:
        self.lines.append(text)


@pytest.mark.parametrize(("held_back", "told"), [(2.5, True), (1.23, True), (1.04, False)])
def test_a_small_dark_part_that_keeps_all_dark_is_named(tmp_path: Path, held_back: float, told: bool) -> None:
    names = write_synthetic_run(tmp_path, projector=(14, 18), camera=CAMERA)
    picture = np.ones((*CAMERA, 3), np.float32)
    everywhere = np.ones(CAMERA, np.bool_)
    figures: dict[str, float | int | str | None] = {
        "exposure": 1.0,
        "reachable_share": 0.9,
        "held_back": held_back,
    }
    made = AppearanceResult(
        tuple(np.ones((14, 18, 3), np.float32) for _ in names),
        picture,
        everywhere,
        picture,
        everywhere,
        everywhere,
        figures,
    )
    request, said = AppearanceRequest("one", "One", lambda: Target(picture, everywhere), {}), Said()
    steps = solve_steps(
        Calibrated(tmp_path, names), [request], options_of(SolveTable()), (), answering=lambda *asked: made
    )
    with Journal(tmp_path) as journal:
        Runner(steps, journal, reporter=said).run("appearance", deadline=in_seconds(60))
    lines = [line for line in said.lines if "a small dark part" in line]
    assert bool(lines) is told
    assert all(
        f"white could be {held_back:.2f} times as bright" in line and "exposure_share = 0.8 " in line for line in lines
    )


@pytest.mark.parametrize(("colour", "told"), [((1.0, 0.0, 0.0), True), ((0.5, 0.5, 0.5), False)])
def test_a_target_that_is_mostly_out_of_reach_is_named(
    tmp_path: Path, colour: tuple[float, float, float], told: bool
) -> None:
    names = write_synthetic_run(tmp_path, projector=(14, 18), camera=CAMERA)
    image = np.broadcast_to(np.array(colour, np.float32), (*CAMERA, 3)).copy()
    request = AppearanceRequest("one", "One", lambda: Target(image, np.ones(CAMERA, np.bool_)), {})
    said = Said()
    with Journal(tmp_path) as journal:
        runner = Runner(solve_steps(Calibrated(tmp_path, names), [request], options_of(SolveTable()), ()), journal,
                        reporter=said)  # fmt: skip
        runner.run("appearance", deadline=in_seconds(60))
    assert any("of the object can be shown as asked for" in line for line in said.lines) is told
