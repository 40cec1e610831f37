"""Work in a thread of its own: every result is reported, kept for those who follow it, and ends nothing else."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from controller.core.errors import WorkError
from controller.kiosk.decide.interfaces import Finished, Request
from controller.kiosk.jobs.job_runner import JobHandler, JobReporter, JobRunner, run_name
from controller.kiosk.state import Job
from controller.kiosk.store.event_log import EventLog
from controller.run.progress import Phase, Progress
from hal.deadline import Cancelled
from hal.errors import DeviceGone
from hal.notices import Level, Notice


def well(request: Request, reporter: JobReporter, cancel: threading.Event) -> Finished:
    return Finished(request, Notice("done", "It is done."))


def raising(error: BaseException) -> JobHandler:
    def do(request: Request, reporter: JobReporter, cancel: threading.Event) -> Finished:
        raise error

    return JobHandler(do)


@pytest.fixture
def log(tmp_path: Path) -> Iterator[EventLog]:
    found = EventLog(tmp_path / "events.sqlite", durable=False)
    yield found
    found.close()


class Ended(threading.Event):
    """Set by the runner's last change of a job."""

    runner: JobRunner

    def changed(self) -> None:
        if self.runner.job is not None and self.runner.job.ended:
            self.set()


def worked(log: EventLog, kind: JobHandler, number: int = 0) -> tuple[JobRunner, Finished]:
    ended = Ended()
    runner = ended.runner = JobRunner({"work": kind}, log, ended.changed, number=number)
    runner.begin(Request("work"))
    assert ended.wait(20)
    runner.close(20)
    finished = runner.finished()
    assert finished is not None
    return runner, finished


@pytest.mark.parametrize(
    ("error", "code", "level"),
    [
        (Cancelled(), Cancelled().code, "info"),
        (WorkError("no-space", what="Full.", remedy="Free some."), "no-space", "error"),
        (DeviceGone("camera-gone", what="Gone.", remedy="Plug it in."), "camera-gone", "error"),
        (KeyError("nobody thought of this"), "crash", "error"),
        (MemoryError(), "crash", "error"),
        (SystemExit(3), "crash", "error"),
    ],
)
def test_whatever_ends_the_work_is_its_outcome(log: EventLog, error: BaseException, code: str, level: str) -> None:
    runner, finished = worked(log, raising(error))
    assert finished.failed
    assert (finished.outcome.code, finished.outcome.level) == (code, level)
    assert runner.running is None
    assert runner.job is not None
    assert (runner.job.ended, runner.job.failed, runner.job.outcome) == (True, True, finished.outcome.text)


@pytest.mark.parametrize(
    "how", [lambda runner: runner.cancel(), lambda runner: runner.close(20)], ids=["cancel", "close"]
)
def test_work_is_asked_to_end(log: EventLog, how: Callable[[JobRunner], None]) -> None:
    def waits(request: Request, reporter: JobReporter, cancel: threading.Event) -> Finished:
        if not cancel.wait(20):
            raise AssertionError("nobody asked")
        raise Cancelled

    ended = Ended()
    runner = ended.runner = JobRunner({"work": JobHandler(waits)}, log, ended.changed)
    runner.begin(Request("work"))
    assert runner.running == Request("work")
    how(runner)
    assert ended.wait(20)
    finished = runner.finished()
    assert finished is not None
    assert finished.outcome.code == Cancelled().code
    runner.close(20)


def test_it_is_finished_once_and_can_be_asked_for_by_its_number(log: EventLog) -> None:
    runner, finished = worked(log, JobHandler(well), number=41)
    assert runner.finished() is None
    assert not finished.failed
    assert runner.number == 42
    job = runner.known(42)
    assert job is not None
    assert (job.ended, job.outcome) == (True, "It is done.")
    assert runner.known(41) is None
    assert runner.known(43) is None


def test_work_for_which_the_system_has_no_thread_has_failed(log: EventLog, monkeypatch: pytest.MonkeyPatch) -> None:
    def start(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    runner = JobRunner({"work": JobHandler(well)}, log)
    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", start)
        runner.begin(Request("work"))
    finished = runner.finished()
    assert finished is not None
    assert (finished.failed, finished.outcome.code) == (True, "crash")
    assert runner.running is None
    runner.close(20)


def test_only_the_last_jobs_are_remembered(log: EventLog) -> None:
    ended = Ended()
    runner = ended.runner = JobRunner({"work": JobHandler(well)}, log, ended.changed)
    for _ in range(20):
        ended.clear()
        runner.begin(Request("work"))
        assert ended.wait(20)
        runner.close(20)
        runner.finished()
    assert [number for number in range(25) if runner.known(number) is not None] == list(range(5, 21))


def test_the_steps_of_a_job_are_those_that_began(log: EventLog) -> None:
    changes: list[int] = []
    reporter = JobReporter(Job(1, "work"), log, lambda: changes.append(1))

    def at(index: int, count: int, phase: Phase, share: float) -> list[tuple[str, float]]:
        reporter.progress(Progress(f"step {index}", index, count, phase, 0.5, share, 1.0, 2.0))
        return [(step.title, step.done) for step in reporter.job.steps]

    assert at(0, 3, Phase.RUNNING, 0.25) == [("step 0", 0.25)]
    assert at(0, 3, Phase.DONE, 0.25) == [("step 0", 1.0)]
    assert at(1, 3, Phase.RUNNING, 0.5) == [("step 0", 1.0), ("step 1", 0.5)]
    # One that runs beside others ends after a later one has begun.
    assert at(3, 4, Phase.RUNNING, 0.5) == [("step 3", 0.5)]
    assert at(2, 4, Phase.DONE, 0.0) == [("step 2", 1.0), ("step 3", 0.5)]
    # Resumed, or another runner: as many steps as that one has.
    assert at(1, 2, Phase.RUNNING, 0.75) == [("step 1", 0.75)]
    reporter.say("Look at this.", Level.WARNING)
    assert (reporter.job.count, reporter.job.left_s, len(changes)) == (2, 2.0, 7)
    assert [(row.level, row.text) for row in log.after(0)] == [("warning", "Look at this.")]


def test_the_name_of_a_run_is_that_of_its_folder() -> None:
    assert run_name({"run": "/somewhere/runs/20260101-100000-calibrate"}) == "20260101-100000-calibrate"
    assert run_name({}) == ""
