"""Common causes as people read them, and as a run keeps them."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from controller.optics.solve.result.common_causes import Cause, CommonCauses
from controller.run.journal import Journal
from controller.run.progress import Silent
from controller.run.runner import Runner
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.solved import Refining
from controller.stage.steps.appearance.refining import causes_step, sentences
from hal.deadline import in_seconds
from hal.notices import Level

NAMES = ("left", "right")
CAUSES = 3 * 2 + 2 + 1 + 3 + 1


@dataclass
class Told(Silent):
    said: list[str] = field(default_factory=list)

    def say(self, text: str, level: Level = Level.INFO) -> None:
        self.said.append(text)


def cause(kind: str, amount: float, projector: int | None = None, colour: str | None = None) -> Cause:
    return Cause(kind, projector, colour, amount, 0.001, 0.5)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("found", "says"),
    [
        ((cause("brightness", -0.1, 0, "red"), cause("brightness", -0.08, 0, "blue")),
         "Projector left is darker (red -10.0 %, blue -8.0 %) than when it was calibrated. `velatura calibrate STAGE"),
        ((cause("brightness", 0.38, 1, "red"),), "Projector right is brighter (red +38.0 %) than when"),
        ((cause("brightness", 0.1, 1, "red"), cause("brightness", -0.1, 1, "blue")),
         "Projector right is darker (blue -10.0 %) and brighter (red +10.0 %) than when"),
        ((cause("response", 0.05, 1),), "The response of projector right has changed (exponents +5 %)."),
        ((cause("indirect", 0.05),), "5 % of the projectors' light comes back from the object and the room."),
        ((cause("indirect", -0.02),),
         "2 % of the projectors' light no longer comes back from the object and the room. If something pale was taken"),
        ((cause("ambient", 0.02, None, "red"),),
         "The light in the room has changed, in parts of the projectors' light: red +2.0 %. Make"),
        ((cause("ambient", -0.02, None, "red"),),
         "The light in the room has changed, in parts of the projectors' light: red -2.0 %. Keep the room so dark,"),
        ((cause("focus", 0.7),), "The pictures are less sharp than the calibration expects. See whether"),
        ((cause("focus", -0.7),), "The pictures are sharper than the calibration expects: something was out of focus"),
    ],
)  # fmt: skip
def test_each_cause_is_told_with_what_corrects_it(found: tuple[Cause, ...], says: str) -> None:
    first, second = sentences(CommonCauses(found, 0.79), NAMES)
    assert first == "The appearances have 79 % of their error (squared) in common."
    assert second.startswith(says)


def test_nothing_is_said_of_nothing() -> None:
    assert sentences(CommonCauses((), 0.02), NAMES) == []


def products(amount: float) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Equations of a photograph in which the first projector is darker, and nothing else has an effect."""
    rng = np.random.default_rng(2)
    images = rng.normal(0, 1, (5000, CAUSES))
    error = images[:, :3].sum(axis=1) * amount + rng.normal(0, 0.01, 5000)
    columns = np.column_stack([images, error])
    return np.vstack([columns.T @ columns, np.full(CAUSES + 1, 5000.0)])


@pytest.mark.parametrize(("counted", "told"), [((True, True), True), ((True, False), False), ((False, False), False)])
def test_two_photographs_at_least_are_needed_and_what_is_found_is_kept(
    tmp_path: Path, counted: tuple[bool, bool], told: bool
) -> None:
    frames = {name: np.zeros((2, 3, 3), np.float32) for name in NAMES}
    for appearance, one in zip(("gold", "marble"), counted, strict=True):
        Refining(frames, None, None, equations=products(-0.1) if one else None).write(tmp_path, appearance, 1)
    step, reporter = causes_step(Calibrated(tmp_path, NAMES), ("gold", "marble"), 1, after=()), Told()
    with Journal(tmp_path) as journal:
        Runner([step], journal, reporter=reporter).run("refine", deadline=in_seconds(30))
    kept = json.loads((tmp_path / "causes.json").read_text())
    assert kept["sentences"] == reporter.said
    assert bool(reporter.said) is told
    assert [row["projector"] for row in kept["causes"]] == ["left"] * 3 * told
    assert [row["amount"] for row in kept["causes"]] == pytest.approx([-0.1] * 3 * told, abs=0.005)


@pytest.mark.parametrize(
    ("next_one", "told"), [({}, True), ({"kept": False}, False), ({"refused": "it is too bright"}, False)]
)
def test_a_photograph_that_the_next_one_denies_names_no_cause(
    tmp_path: Path, next_one: dict[str, object], told: bool
) -> None:
    """A flash during all exposures of a photograph looks like a projector that became darker or brighter."""
    frames = {name: np.zeros((2, 3, 3), np.float32) for name in NAMES}
    for appearance, after in (("gold", next_one), ("marble", {})):
        Refining(frames, None, None, equations=products(-0.1), photographs=({}, after)).write(tmp_path, appearance, 1)
    step = causes_step(Calibrated(tmp_path, NAMES), ("gold", "marble"), 1, after=())
    with Journal(tmp_path) as journal:
        Runner([step], journal, reporter=Told()).run("refine", deadline=in_seconds(30))
    assert bool(json.loads((tmp_path / "causes.json").read_text())["causes"]) is told
