from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from controller.core.errors import WorkError
from controller.core.storage import write_atomically
from controller.run.journal import Journal
from controller.run.progress import Phase
from controller.run.runner import Context, Runner, Step
from controller.run.state_machine import Event, Machine, State
from controller.run.step_id import StepId
from hal.deadline import Cancelled, in_seconds
from hal.errors import DeviceGone
from tests.controller.run.listening import Listening


@pytest.fixture
def journal(tmp_path: Path) -> Iterator[Journal]:
    with Journal(tmp_path) as opened:
        yield opened


def writes(
    name: str, calls: list[str], data: Callable[[], bytes] = lambda: b"x"
) -> Callable[[Context], Sequence[Path]]:
    def run(context: Context) -> Sequence[Path]:
        calls.append(name)
        write_atomically(context.folder / name, data())
        return [context.folder / name]

    return run


def test_steps_run_in_order_and_hand_on_their_artefacts(journal: Journal) -> None:
    def joined(context: Context) -> Sequence[Path]:
        write_atomically(context.folder / "c", b"".join(path.read_bytes() for path in context.paths(StepId("a"))))
        return [context.folder / "c"]

    steps = [Step(StepId("a"), writes("a", [], lambda: b"made by a")), Step(StepId("c"), joined, after=(StepId("a"),))]
    results = Runner(steps, journal).run("test", deadline=in_seconds(10))
    assert results[StepId("c")][0].path.read_bytes() == b"made by a"


def test_what_is_done_is_skipped_and_what_depends_on_a_change_runs_again(journal: Journal) -> None:
    calls: list[str] = []
    content = [b"1"]
    setting = ["low"]

    def steps() -> list[Step]:
        return [
            Step(StepId("a"), writes("a", calls, lambda: content[0]), inputs={"setting": setting[0]}),
            Step(StepId("b"), writes("b", calls), after=(StepId("a"),)),
            Step(StepId("other"), writes("other", calls)),
        ]

    def once() -> list[str]:
        calls.clear()
        Runner(steps(), journal).run("test", deadline=in_seconds(10))
        return list(calls)

    assert once() == ["a", "b", "other"]
    assert once() == []
    setting[0] = "high"
    assert once() == ["a"], "the same artefact from another setting changes nothing further on"
    setting[0], content[0] = "highest", b"2"
    assert once() == ["a", "b"]


def test_hardware_steps_run_every_time(journal: Journal) -> None:
    calls: list[str] = []
    steps = [Step(StepId("power"), writes("power", calls), always=True), Step(StepId("a"), writes("a", calls))]
    for _ in range(2):
        Runner(steps, journal).run("test", deadline=in_seconds(10))
    assert calls == ["power", "a", "power"]


def test_the_machine_goes_along_and_stays_out_of_skipped_steps(journal: Journal) -> None:
    calls: list[str] = []
    steps = [Step(StepId("calibrate"), writes("a", calls), enter=Event.RECALIBRATE, leave=Event.CALIBRATED)]
    for states in ([State.CALIBRATING, State.READY], []):
        seen: list[State] = []
        machine = Machine(lambda change, seen=seen: seen.append(change.after), state=State.READY)  # type: ignore[misc]
        Runner(steps, journal, machine=machine).run("test", deadline=in_seconds(10))
        assert seen == states


@pytest.mark.parametrize(
    ("error", "state"),
    [
        (DeviceGone("camera-unplugged", what="The camera left.", remedy="Plug it in."), State.FAULT),
        (WorkError("too-dark", what="Too dark.", remedy="More light."), State.READY),
        (Cancelled(), State.READY),
    ],
)
def test_a_failure_is_journalled_and_the_machine_is_told_why(journal: Journal, error: Exception, state: State) -> None:
    def fails(context: Context) -> Sequence[Path]:
        raise error

    machine = Machine(state=State.READY)
    steps = [Step(StepId("calibrate"), fails, enter=Event.RECALIBRATE, leave=Event.CALIBRATED)]
    with pytest.raises(type(error)):
        Runner(steps, journal, machine=machine).run("test", deadline=in_seconds(10))
    code, what = getattr(error, "code", ""), getattr(error, "what", "")
    assert (machine.state, machine.reason) == (state, what)
    assert [(event.code, event.text) for event in journal.events()] == [(code, what)]
    assert journal.outcomes() == [("test", code)]


def test_a_failing_journal_does_not_hide_what_went_wrong(journal: Journal) -> None:
    def fails(context: Context) -> Sequence[Path]:
        journal.close()
        raise WorkError("too-dark", what="Too dark.", remedy="More light.")

    with pytest.raises(WorkError) as error:
        Runner([Step(StepId("a"), fails)], journal).run("test", deadline=in_seconds(10))
    assert error.value.code == "too-dark"
    assert any("could not be written to the journal" in note for note in error.value.__notes__)


def test_cancel_takes_hold_between_steps_and_inside_them(journal: Journal) -> None:
    cancel, calls = threading.Event(), list[str]()

    def stops(context: Context) -> Sequence[Path]:
        context.advance(0.1)
        cancel.set()
        context.advance(0.2)
        raise AssertionError("not reached")

    for steps in ([Step(StepId("a"), stops)], [Step(StepId("b"), writes("b", calls))]):
        with pytest.raises(Cancelled):
            Runner(steps, journal).run("test", deadline=in_seconds(10, cancel))
    assert calls == []


def test_a_run_out_of_time_says_that_it_can_go_on(journal: Journal) -> None:
    with pytest.raises(WorkError, match="to continue after the last finished step") as error:
        Runner([Step(StepId("a"), writes("a", []))], journal).run("test", deadline=in_seconds(0))
    assert error.value.code == "run-too-slow"


def test_progress_names_steps_and_reaches_the_end(journal: Journal) -> None:
    steps = [
        Step(StepId("a"), writes("a", []), weight=1, title="Take pictures"),
        Step(StepId("b"), writes("b", []), weight=3),
    ]
    for phase in (Phase.DONE, Phase.SKIPPED):
        reporter = Listening()
        Runner(steps, journal, reporter=reporter).run("test", deadline=in_seconds(10))
        assert [now.step for now in reporter.told if now.phase is phase] == ["Take pictures", "b"]
        assert reporter.told[-1].fraction == 1.0


def test_steps_that_read_from_later_ones_or_share_a_name_are_refused(journal: Journal) -> None:
    with pytest.raises(ValueError, match="'b'"):
        Runner([Step(StepId("b"), writes("b", []), after=(StepId("a"),)), Step(StepId("a"), writes("a", []))], journal)
    with pytest.raises(ValueError, match="'a'"):
        Runner([Step(StepId("a"), writes("a", [])), Step(StepId("a"), writes("a", []))], journal)
