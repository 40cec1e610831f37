"""Who asks for a refinement, what is left to do of it, and what becomes of a stage without its devices."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controller.run.progress import Reporter, Silent
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.solved import read_refining, write_refined
from controller.stage.services.refine import Refinement, refine, refinement_of
from controller.stage.sessions.check import Checked, check_stage
from controller.stage.sessions.session import StageSession, StageWork
from hal.deadline import Cancelled
from hal.errors import DeviceError, DeviceGone, DeviceRefused
from hal.notices import Level
from tests.controller.stage.rig.rig_model import ModelRig
from tests.controller.stage.services.test_calibrate import write
from tests.controller.stage.steps.appearance.test_publishing import OUTPUTS, solve

TITLES = {"gold": "Gold", "marble": "Marble"}
GONE = DeviceGone("camera-gone", what="The camera is gone.", remedy="Plug it in.")


@dataclass
class Session(StageSession):
    """Notes the steps that it was asked to run; ``error`` instead of them, or before the devices are ``opened``."""

    stage: Path
    error: Exception | None = None
    opened: bool = True
    asked: list[tuple[str, list[str]]] = field(default_factory=list)

    def locked(self) -> contextlib.AbstractContextManager[None]:
        return contextlib.nullcontext()

    def run(self, checked: Checked, work: StageWork, *, reporter: Reporter, cancel: threading.Event) -> Path:
        assert work.dark, "room light would be taken for an error"
        if self.error is not None and not self.opened:
            raise self.error
        steps = work.make_steps(ModelRig(self.stage).rig, self.stage)
        self.asked.append((work.name, [str(step.id) for step in steps]))
        if self.error is not None:
            raise self.error
        return self.stage


@dataclass
class Told(Silent):
    said: list[tuple[Level, str]] = field(default_factory=list)

    def say(self, text: str, level: Level = Level.INFO) -> None:
        self.said.append((level, text))


@dataclass
class Stage:
    folder: Path
    run: Path
    told: Told = field(default_factory=Told)

    def refine(
        self, refinement: Refinement, error: Exception | None = None, opened: bool = True
    ) -> tuple[Session, Mapping[str, Any]]:
        session = Session(self.folder, error, opened)
        calibrated = Calibrated(self.run, tuple(OUTPUTS))
        result = refine(
            session, check_stage(self.folder), calibrated, TITLES, refinement,
            reporter=self.told, cancel=threading.Event(),
        )  # fmt: skip
        return session, result

    def refined(self, name: str, asked: int) -> None:
        frames = {p: np.zeros((rows, columns, 3), np.uint8) for p, (_, (columns, rows)) in OUTPUTS.items()}
        linear = {projector: frame.astype(np.float32) for projector, frame in frames.items()}
        figures = {"asked": asked, "before": 1.5, "after": 0.5, "ended": "", "photographs": [{}]}
        write_refined(self.run, name, frames, linear, figures)


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    write(tmp_path)
    run = tmp_path / "runs" / "20260101-120000-calibrate"
    for name in TITLES:
        solve(run, name, 1)
    return Stage(tmp_path, run)


def test_what_is_typed_goes_before_stage_toml(tmp_path: Path) -> None:
    write(tmp_path)
    assert refinement_of(tmp_path, None) == Refinement(1, asked=False), "the default"
    file = tmp_path / "stage.toml"
    file.write_text(file.read_text() + "\n[solve]\nrefine = 3\n")
    assert refinement_of(tmp_path, None) == Refinement(3, asked=False)
    assert refinement_of(tmp_path, 0) == Refinement(0)


def test_each_photograph_is_a_step_and_the_better_frames_are_the_last(stage: Stage) -> None:
    session, _ = stage.refine(Refinement(2))
    ((name, steps),) = session.asked
    assert name == "refine"
    assert steps == ["refine-1-gold", "refine-2-gold", "refine-3-gold", "refined-gold",
                     "refine-1-marble", "refine-2-marble", "refine-3-marble", "refined-marble", "causes"]  # fmt: skip


def test_what_is_refined_already_is_refined_again_only_when_asked(stage: Stage) -> None:
    stage.refined("gold", 1)
    session, result = stage.refine(Refinement(1, asked=False))
    assert session.asked[0][1] == ["refine-1-marble", "refine-2-marble", "refined-marble"]
    assert result["refined"] == "Refined gold: 1.50 to 0.50 (CIEDE2000 median) with 1 photograph."
    assert len(stage.refine(Refinement(1))[0].asked[0][1]) == 7
    assert len(stage.refine(Refinement(2, asked=False))[0].asked[0][1]) == 9
    stage.refined("marble", 1)
    assert stage.refine(Refinement(1, asked=False))[0].asked == [], "no lamp is lit for nothing"


def test_none_drops_what_was_refined_and_lights_nothing(stage: Stage) -> None:
    stage.refined("gold", 1)
    session, result = stage.refine(Refinement(0))
    assert (session.asked, result) == ([], {})
    assert read_refining(stage.run, "gold") is None


@pytest.mark.parametrize(
    ("error", "opened"), [(GONE, False), (DeviceRefused("room-not-dark", what="It is bright.", remedy="Wait."), True)]
)
def test_where_no_lamp_can_be_lit_the_solved_frames_stay_unless_asked(
    stage: Stage, error: DeviceError, opened: bool
) -> None:
    with pytest.raises(type(error)):
        stage.refine(Refinement(1), error, opened)
    assert stage.told.said == []
    assert stage.refine(Refinement(1, asked=False), error, opened)[1] == {"refined": ""}
    ((level, text),) = stage.told.said
    assert level is Level.WARNING
    assert text.startswith(f"The appearances were not refined: {error.what} {error.remedy} Then ")


@pytest.mark.parametrize(
    ("error", "opened"),
    [
        (GONE, True),
        (DeviceError("lamp-still-lit", what="It is lit.", remedy="Switch it off."), True),
        (Cancelled(), False),
    ],
)
def test_what_fails_once_lamps_may_be_lit_and_a_stop_are_never_hidden(
    stage: Stage, error: DeviceError, opened: bool
) -> None:
    with pytest.raises(type(error)):
        stage.refine(Refinement(1, asked=False), error, opened)
