"""Everything that the panel does, the command line does; and a job is followed to its end."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
import typer

from controller.__main__ import application, run
from controller.cli.groups import words_of
from controller.core.errors import VelaturaError, WorkError
from controller.core.storage import runtime_folder
from controller.kiosk.api.control import NAME, ControlServer
from controller.kiosk.api.offline_dispatch import ask_and_follow
from controller.kiosk.operations.table import OPERATIONS
from controller.run.progress import Progress, Silent
from hal.deadline import Cancelled
from tests.controller.kiosk.test_boot import STAGE


def test_every_operation_has_a_command_that_exists() -> None:
    assert {operation.words for operation in OPERATIONS} <= set(words_of(typer.main.get_command(application())))


def answered(capsys: pytest.CaptureFixture[str], *words: str | Path) -> str:
    assert run([str(word) for word in words]) == 0
    return capsys.readouterr().out


def test_accounts_of_a_stage_that_nobody_serves(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "stage.toml").write_text(STAGE)
    read, write = os.pipe()
    os.write(write, b"a long pass phrase\n")
    os.close(write)
    with os.fdopen(read) as typed:
        monkeypatch.setattr(sys, "stdin", typed)
        answered(capsys, "kiosk", "account", "add", tmp_path, "tina", "--role", "technician")
    assert answered(capsys, "kiosk", "account", "add-token", tmp_path, "watch").startswith("velatura_")
    assert answered(capsys, "kiosk", "account", "list", tmp_path).split("\n")[:2] == [
        f"{'tina':<32} technician", f"{'watch':<32} viewer, token",
    ]  # fmt: skip
    assert run(["kiosk", "account", "remove", str(tmp_path), "tina"]) != 0, "the last technician stays"


def test_settings_are_checked_before_they_are_used(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "stage.toml").write_text(STAGE)
    wrong, right = tmp_path / "wrong.toml", tmp_path / "right.toml"
    wrong.write_text(STAGE.replace("iso = 100", "iso = 1"))
    right.write_text(STAGE.replace("iso = 100", "iso = 200"))
    assert run(["kiosk", "settings", str(tmp_path), "--save", str(wrong)]) != 0
    assert answered(capsys, "kiosk", "settings", tmp_path) == STAGE + "\n"
    answered(capsys, "kiosk", "settings", tmp_path, "--save", right)
    assert "iso = 200" in answered(capsys, "kiosk", "settings", tmp_path)


class ModelJob:
    """A kiosk that answers the questions of somebody who follows: one answer a question."""

    def __init__(self, *jobs: dict[str, Any] | None) -> None:
        self._jobs = list(jobs)
        self.cancelled = False

    def job(self, number: int) -> dict[str, Any] | None:
        assert number == 4
        return self._jobs.pop(0) if len(self._jobs) > 1 else self._jobs[0]

    def recalibrate(self, kind: str, projector: str | None = None) -> dict[str, Any]:
        return {"number": 4}

    def cancel(self) -> None:
        self.cancelled = True

    def served(self, stage: Path) -> ControlServer:
        operations: dict[str, Callable[..., Any]] = {"job": self.job, "cancel": self.cancel}
        operations["recalibrate"] = self.recalibrate
        return ControlServer(runtime_folder(stage.resolve()) / NAME, operations)


def job(number: int, done: float = 0.0, *, ended: bool = False, failed: bool = False) -> dict[str, Any]:
    steps, outcome = [{"title": "Power", "done": done}], "It is so." if ended else ""
    return {"number": number, "name": "Full recalibration", "steps": steps, "left_s": 3.0, "count": 7,
            "ended": ended, "failed": failed, "outcome": outcome, "run": "one"}  # fmt: skip


def follow(stage: Path, reporter: Silent, cancel: threading.Event | None = None) -> Mapping[str, Any]:
    return ask_and_follow(
        stage=stage, op="recalibrate", arguments={"kind": "full"}, reporter=reporter,
        cancel=cancel or threading.Event(), every_s=0.001,
    )  # fmt: skip


class Kept(Silent):
    def __init__(self) -> None:
        self.kept: list[Progress] = []

    def progress(self, now: Progress) -> None:
        self.kept.append(now)


def test_a_job_is_followed_from_before_it_begins_to_its_end(tmp_path: Path) -> None:
    told = Kept()
    with ModelJob(None, job(4, 0.25), job(4, 0.5), job(4, 1.0, ended=True)).served(tmp_path):
        assert follow(tmp_path, told) == {"job": "Full recalibration", "outcome": "It is so.", "run": "one"}
    assert [(one.step_fraction, one.count) for one in told.kept] == [(0.25, 7), (0.5, 7)]
    assert all(one.fraction == pytest.approx(one.elapsed_s / (one.elapsed_s + 3.0)) for one in told.kept)


def test_a_job_that_failed_is_an_error_with_the_kiosks_own_sentence(tmp_path: Path) -> None:
    with ModelJob(job(4, ended=True, failed=True)).served(tmp_path), pytest.raises(WorkError) as caught:
        follow(tmp_path, Kept())
    assert caught.value.what == "Full recalibration: It is so."


def test_whoever_stops_following_stops_the_job(tmp_path: Path) -> None:
    kiosk, cancel = ModelJob(job(4, 0.25)), threading.Event()
    cancel.set()
    with kiosk.served(tmp_path), pytest.raises((Cancelled, VelaturaError)):
        follow(tmp_path, Kept(), cancel)
    assert kiosk.cancelled
