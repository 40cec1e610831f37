"""The queue of jobs, with models of jobs and lamps: skipped tasks are reported, and nothing waits forever."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest

from controller.core.errors import WorkError
from controller.kiosk.decide.interfaces import NOT_YET, Condition, Finished, ProjectorView, Request
from controller.kiosk.decide.job_queue import JobQueue
from controller.kiosk.decide.planner import Plan, Task
from controller.kiosk.store.event_log import EventLog
from hal.notices import Level, Notice

DRIFT = Task("drift-check 2026-05-05", "drift check", 0.0, 3600.0)
LIT = ProjectorView("left", Condition.LIT, stable_left_s=0.0, looked=True)
WARM = replace(LIT, stable_left_s=60.0)
DARK = replace(LIT, condition=Condition.BROKEN)
QUICK, PUBLISH, REPORT, FULL = (
    Request("quick", light=True),
    Request("publish"),
    Request("report"),
    Request("full", True),
)
PATIENCE_S = 100.0


@dataclass
class Jobs:
    """Ends when it is asked to."""

    refused: Notice | None = None
    running: Request | None = None
    done: list[Request] = field(default_factory=list)
    cancelled: int = 0
    result: Finished | None = None

    def refusal(self, request: Request) -> Notice | None:
        return self.refused

    def begin(self, request: Request) -> None:
        assert self.running is None, "two at once"
        self.running = request
        self.done.append(request)

    def end(self, *then: Request, failed: bool = False) -> None:
        assert self.running is not None
        self.result = Finished(self.running, Notice("ended", "It ended."), failed, then)

    def finished(self) -> Finished | None:
        found, self.result = self.result, None
        if found is not None:
            self.running = None
        return found

    def cancel(self) -> None:
        self.cancelled += 1


class Desk:
    def __init__(self) -> None:
        self.now_s = 0.0
        self.log = EventLog(Path(":memory:"), durable=False)
        self.begin_anew()

    def begin_anew(self) -> None:
        """As a service that was killed and starts."""
        self.jobs = Jobs()
        self.queue = JobQueue(self.jobs, self.log, monotonic=lambda: self.now_s, patience_s=PATIENCE_S)

    def begin(self, *views: ProjectorView) -> Request | None:
        """What begins with these lamps."""
        request = self.queue.ready(views)
        if request is not None:
            self.queue.begin()
        return request

    @property
    def told(self) -> list[str]:
        return [row.code for row in self.log.after(0)]


@pytest.fixture
def desk() -> Iterator[Desk]:
    found = Desk()
    yield found
    found.log.close()


def test_work_that_a_power_cut_ended_is_told_and_done_again_once_unless_it_needs_the_lamps(desk: Desk) -> None:
    desk.queue.submit(FULL, REPORT)
    desk.begin(LIT)
    desk.begin_anew()
    assert desk.queue.go_on() == [(FULL, False), (REPORT, True)]
    assert desk.begin(DARK) == REPORT
    desk.begin_anew()
    assert desk.queue.go_on() == [(REPORT, False)], "what ends the kiosk is not begun again and again"
    assert desk.begin(LIT) is None
    desk.begin_anew()
    assert desk.queue.go_on() == []
    desk.queue.submit(FULL)
    desk.begin(LIT)
    desk.jobs.end(PUBLISH)
    desk.queue.take_finished()
    desk.begin_anew()
    assert desk.queue.go_on() == [(PUBLISH, True)], "what follows a calibration is not lost with the power"
    desk.begin()
    desk.jobs.end()
    desk.queue.take_finished()
    desk.begin_anew()
    assert desk.queue.go_on() == []


@pytest.mark.parametrize("cancelled_while", ["it waits", "it runs"])
def test_work_that_was_cancelled_is_not_done_again(desk: Desk, cancelled_while: str) -> None:
    desk.queue.submit(PUBLISH, REPORT)
    if cancelled_while == "it runs":
        desk.begin()
    desk.queue.cancel()
    desk.begin_anew()
    assert desk.queue.go_on() == []


def test_a_nightly_check_that_a_power_cut_ended_is_told_and_not_begun_again_that_night(desk: Desk) -> None:
    desk.queue.take_due(Plan(None, due=(DRIFT,)), playing=False)
    assert desk.log.done() == frozenset(), "until it begins, it is due again anyway"
    desk.begin_anew()
    assert desk.queue.go_on() == []
    desk.queue.take_due(Plan(None, due=(DRIFT,)), playing=False)
    assert desk.begin(LIT) is not None
    assert desk.log.done() == {DRIFT.key}
    desk.begin_anew()
    assert [(request.kind, again) for request, again in desk.queue.go_on()] == [("drift", False)]
    assert desk.begin(LIT) is None


def test_what_follows_a_nightly_check_is_done_again_after_a_power_cut(desk: Desk) -> None:
    desk.queue.take_due(Plan(None, due=(DRIFT,)), playing=False)
    desk.begin(LIT)
    desk.jobs.end(replace(PUBLISH, key=DRIFT.key))
    desk.queue.take_finished()
    desk.begin_anew()
    assert desk.queue.go_on() == [(PUBLISH, True)]


@pytest.mark.parametrize("text", ["", "{", "[1]", '[["publish"]]', "7", '[["publish", false, 3, false]]', "null"])
def test_kept_work_that_can_not_be_read_keeps_no_kiosk_from_starting(desk: Desk, text: str) -> None:
    desk.log.keep("work", text)
    assert desk.queue.go_on() == []
    desk.queue.submit(PUBLISH)
    assert desk.begin() == PUBLISH


def test_kept_work_that_is_refused_now_is_told_and_not_begun(desk: Desk) -> None:
    desk.queue.submit(PUBLISH)
    desk.begin()
    desk.begin_anew()
    desk.jobs.refused = Notice("no-calibration", "There is no calibration.")
    assert desk.queue.go_on() == [(PUBLISH, False)]
    assert desk.begin() is None


def test_what_follows_comes_before_what_waits_and_in_its_order(desk: Desk) -> None:
    desk.queue.submit(FULL, REPORT)
    assert desk.begin(LIT) == FULL
    desk.jobs.end(PUBLISH, QUICK)
    desk.queue.take_finished()
    assert desk.told == ["ended"]
    for expected in (PUBLISH, QUICK, REPORT):
        assert desk.begin(LIT) == expected
        assert desk.begin(LIT) is None, "one at a time"
        desk.jobs.end()
        desk.queue.take_finished()
    assert desk.queue.head is None


def test_other_work_is_refused_while_some_waits_or_runs_and_a_refusal_is_told(desk: Desk) -> None:
    desk.queue.submit(FULL)
    for _ in range(2):
        with pytest.raises(WorkError) as caught:
            desk.queue.submit(QUICK)
        assert caught.value.code == "busy"
        assert not desk.queue.offer(PUBLISH)
        desk.begin(LIT)
    desk.jobs.end()
    desk.queue.take_finished()
    desk.jobs.refused = Notice("camera-gone", "No camera.", "Plug it in.", Level.ERROR)
    with pytest.raises(WorkError) as caught:
        desk.queue.submit(QUICK)
    assert (caught.value.code, desk.told[-1]) == ("camera-gone", "camera-gone")
    assert not desk.queue.offer(PUBLISH)
    assert desk.queue.head is None
    desk.jobs.refused = None
    assert desk.queue.offer(PUBLISH)
    assert desk.queue.head == PUBLISH


VARIANTS = Request("variants")


def test_what_nobody_waits_for_makes_way_for_people_and_is_done_afterwards(desk: Desk) -> None:
    desk.queue.offer(VARIANTS)
    assert desk.begin() == VARIANTS
    desk.queue.submit(FULL)
    assert desk.jobs.cancelled == 1
    with pytest.raises(WorkError, match="Full recalibration waits"):
        desk.queue.submit(QUICK)
    desk.jobs.end(failed=True)
    desk.queue.take_finished()
    assert desk.begin(LIT) == FULL
    with pytest.raises(WorkError, match="Full recalibration is running"):
        desk.queue.submit(QUICK)
    desk.jobs.end(PUBLISH)
    desk.queue.take_finished()
    assert desk.begin() == PUBLISH
    desk.jobs.end(VARIANTS)
    desk.queue.take_finished()
    assert desk.begin() == VARIANTS
    desk.jobs.end()
    desk.queue.take_finished()
    assert desk.queue.head is None, "once is enough"
    assert "cancelled" not in " ".join(desk.told)


def test_only_what_failed_stays_in_sight(desk: Desk) -> None:
    desk.queue.submit(QUICK)
    desk.begin(LIT)
    desk.jobs.end()
    desk.queue.take_finished()
    assert not desk.log.failures
    desk.queue.submit(QUICK)
    desk.begin(LIT)
    desk.jobs.result = Finished(QUICK, Notice("lost", "The camera is gone.", "Plug it in.", Level.ERROR), True)
    desk.queue.take_finished()
    desk.queue.submit(QUICK)
    desk.queue.drop(Notice("dark", "A lamp is not lit.", "", Level.ERROR))
    assert [row.code for row in desk.log.failures] == ["lost", "dark"]


def test_nothing_follows_from_work_that_was_cancelled_though_it_ended_well(desk: Desk) -> None:
    desk.queue.submit(replace(FULL, key="night"), REPORT)
    desk.begin(LIT)
    desk.queue.cancel()
    assert desk.jobs.cancelled == 1
    assert desk.told == ["work-cancelled"], "what waited"
    desk.jobs.end(replace(PUBLISH, key="night"))
    finished = desk.queue.take_finished()
    assert finished is not None
    assert finished.then == ()
    assert desk.queue.head is None
    assert desk.log.done() == {"night"}
    # The next work is another matter.
    desk.queue.submit(QUICK)
    desk.begin(LIT)
    desk.jobs.end(PUBLISH)
    desk.queue.take_finished()
    assert desk.queue.head == PUBLISH


def test_cancelling_nothing_tells_nothing(desk: Desk) -> None:
    desk.queue.cancel()
    assert (desk.told, desk.jobs.cancelled) == ([], 0)


def test_a_nightly_task_is_due_once_and_what_follows_it_is_done(desk: Desk) -> None:
    desk.queue.take_due(Plan(False, due=(DRIFT,)), playing=False)
    desk.queue.take_due(Plan(False, due=(DRIFT,)), playing=False)
    assert desk.told == ["task-due"], "once"
    assert desk.begin(LIT) == Request("drift", light=True, key=DRIFT.key)
    desk.jobs.end(replace(QUICK, key=DRIFT.key))
    desk.queue.take_finished()
    assert desk.log.done() == {DRIFT.key}
    assert desk.begin(LIT) == replace(QUICK, key=DRIFT.key)
    desk.jobs.end(REPORT)
    desk.queue.take_finished()
    assert desk.begin() == REPORT


def test_a_task_is_not_due_while_the_stage_plays_and_is_left_out_when_its_time_is_over(desk: Desk) -> None:
    desk.queue.take_due(Plan(True, due=(DRIFT,)), playing=True)
    assert desk.queue.head is None
    desk.queue.take_due(Plan(True, expired=(DRIFT,)), playing=True)
    assert desk.log.done() == {DRIFT.key}
    assert desk.told == ["task-left-out"]


def test_a_task_that_is_due_when_the_kiosk_starts_waits_for_the_camera(desk: Desk) -> None:
    desk.jobs.refused = Notice(NOT_YET, "The camera is not connected yet.", "Wait for it.")
    desk.queue.take_due(Plan(False, due=(DRIFT,)), playing=False)
    assert (desk.log.done(), desk.told) == (frozenset(), [])
    desk.jobs.refused = None
    desk.queue.take_due(Plan(False, due=(DRIFT,)), playing=False)
    assert desk.told == ["task-due"]


def test_a_task_that_can_not_be_done_is_left_out_with_the_reason(desk: Desk) -> None:
    desk.jobs.refused = Notice("camera-gone", "No camera.", "Plug it in.", Level.ERROR)
    desk.queue.take_due(Plan(False, due=(DRIFT,)), playing=False)
    assert desk.log.done() == {DRIFT.key}
    (row,) = desk.log.after(0)
    assert (row.level, row.code) == ("warning", "camera-gone")
    assert DRIFT.key in row.text
    assert "No camera." in row.text


@pytest.mark.parametrize(
    ("views", "code"),
    [((DARK, LIT), "work-needs-all-lamps"), ((WARM, LIT), "lamps-not-steady"),
     ((replace(LIT, condition=Condition.LIGHTING), LIT), "work-needs-all-lamps")],
)  # fmt: skip
def test_work_waits_for_its_light_so_long_and_is_then_given_up(
    desk: Desk, views: tuple[ProjectorView, ...], code: str
) -> None:
    desk.queue.submit(replace(FULL, key="night"), REPORT)
    coming = replace(LIT, condition=Condition.LIGHTING)
    assert desk.begin(coming, LIT) is None
    desk.now_s = PATIENCE_S
    assert desk.begin(coming, LIT) is None
    assert desk.told == []
    desk.now_s += 1.0
    assert desk.begin(*views) is None
    assert desk.told == [code]
    assert desk.queue.head is None
    assert desk.log.done() == {"night"}


def test_the_next_work_has_all_the_patience_again(desk: Desk) -> None:
    desk.queue.submit(FULL)
    assert desk.begin(WARM) is None
    desk.queue.cancel()
    desk.now_s = 2 * PATIENCE_S
    desk.queue.submit(QUICK)
    assert desk.begin(WARM) is None
    assert desk.begin(LIT) == QUICK


def test_work_without_light_begins_in_the_dark(desk: Desk) -> None:
    desk.queue.submit(PUBLISH)
    assert not desk.queue.needs_light
    assert desk.begin(DARK) == PUBLISH
