"""Which appearances a new bundle gets where one of them can't be begun, or fails while it is solved."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from controller.core.errors import CalibrationError, UsageError, WorkError
from controller.kiosk.jobs.job_handlers import publish_appearances
from controller.run.progress import Silent
from controller.stage.services import calibrate as services
from controller.stage.sessions.session import BorrowedSession
from hal.deadline import Cancelled
from tests.controller.kiosk.vase import graded_run, vase

Make = Callable[[Sequence[str]], None]


@pytest.fixture
def stage(tmp_path: Path) -> Path:
    """Its "glass" is not a picture; "marble" and "wood" need none."""
    stage = vase(tmp_path)
    graded_run(stage, "20260101-100000-calibrate", {"left": 0.01})
    with (stage / "stage.toml").open("a") as toml:
        toml.write('\n[[appearances]]\nname = "wood"\nkind = "gloss"\n')
    return stage


def published(stage: Path, monkeypatch: pytest.MonkeyPatch, make: Make) -> Any:
    monkeypatch.setattr(services, "make_appearances", lambda order, **_: make(order.names))
    return publish_appearances(BorrowedSession(stage), reporter=Silent(), cancel=threading.Event())


def test_one_that_can_not_be_begun_is_named_and_the_others_are_solved(
    stage: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Sequence[str]] = []
    found = published(stage, monkeypatch, asked.append)
    assert asked == [("marble", "wood")]
    assert found.names == ("marble", "wood")
    assert list(found.failed) == ["glass"]
    assert found.failures.startswith("glass was not solved: ")


def test_one_that_fails_while_it_is_solved_stops_no_other(stage: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def make(names: Sequence[str]) -> None:
        if "marble" in names:
            raise WorkError("no-pattern", what="The object has no pattern.", remedy="Choose another kind.")

    found = published(stage, monkeypatch, make)
    assert found.names == ("wood",)
    assert found.failed["marble"] == "The object has no pattern. Choose another kind."


@pytest.mark.parametrize(
    "error",
    [CalibrationError("calibration-below-grade", what="Grade D.", remedy="Calibrate."),
     UsageError("no-signing-key", what="There is no key.", remedy="Make one.")],
)  # fmt: skip
def test_what_concerns_all_is_told_as_it_is(
    stage: Path, monkeypatch: pytest.MonkeyPatch, error: WorkError | UsageError
) -> None:
    def make(names: Sequence[str]) -> None:
        raise error

    with pytest.raises(type(error)) as caught:
        published(stage, monkeypatch, make)
    assert caught.value is error


def test_who_cancels_does_not_wait_for_each_of_them(stage: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Sequence[str]] = []

    def make(names: Sequence[str]) -> None:
        asked.append(names)
        raise Cancelled

    with pytest.raises(Cancelled):
        published(stage, monkeypatch, make)
    assert len(asked) == 1
