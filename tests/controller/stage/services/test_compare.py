"""What is to be photographed is found, or refused, before a device is opened."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from controller.core.errors import UsageError
from controller.run.journal import Journal
from controller.run.progress import Silent
from controller.stage.artefacts.kinds import CALIBRATED
from controller.stage.services.compare import installed, photograph
from controller.stage.sessions.check import check_stage
from controller.stage.sessions.session import OwnSession
from hal.notices import Level
from tests.controller.stage.services.test_calibrate import write
from tests.controller.stage.steps.appearance.test_publishing import publish, solve

RUN = "20260101-120000-calibrate"


class Told(Silent):
    def __init__(self) -> None:
        self.said: list[str] = []

    def say(self, text: str, level: Level = Level.INFO) -> None:
        self.said.append(text)


@pytest.fixture
def stage(tmp_path: Path) -> Path:
    """Two appearances are installed, of a calibration that is finished."""
    run = tmp_path / "runs" / RUN
    for number, name in enumerate(("gold", "marble")):
        solve(run, name, number)
    publish(tmp_path, run, "gold", "marble")
    with Journal(run) as journal:
        journal.complete(CALIBRATED, {}, [], began_at_s=time.time())
    write(tmp_path, unsigned=True)
    return tmp_path


def refusal(stage: Path, names: Sequence[str] = ()) -> str:
    with pytest.raises(UsageError) as refused:
        photograph(session=OwnSession(stage), names=names, reporter=Silent(), cancel=threading.Event())
    assert not list((stage / "runs").glob("*-compare"))
    return refused.value.code


def test_all_that_is_installed_is_photographed_or_what_is_named(stage: Path) -> None:
    checked = check_stage(stage)
    assert installed(checked, (), Silent()).names == ("gold", "marble")
    found = installed(checked, ("marble", "marble"), Silent())
    assert (found.names, found.run) == (("marble",), stage / "runs" / RUN)


def test_a_bundle_without_its_targets_is_refused_and_a_part_of_them_is_told(stage: Path) -> None:
    checked, told = check_stage(stage), Told()
    (stage / "runs" / RUN / "appearance-gold.npz").unlink()
    assert installed(checked, (), told).names == ("marble",)
    assert told.said == ["Not photographed, because the target is missing: gold."]
    assert refusal(stage, ("gold",)) == "targets-missing"
    shutil.move(stage / "runs" / RUN, stage / "runs" / "20260102-120000-calibrate")
    assert refusal(stage) == "targets-missing"


def test_what_can_not_be_photographed_is_told_before_a_lamp_is_lit(stage: Path) -> None:
    assert refusal(stage, ("glass",)) == "appearance-unknown"
    shutil.rmtree(stage / "bundles")
    assert refusal(stage) == "nothing-installed"
