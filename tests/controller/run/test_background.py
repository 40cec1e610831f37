"""Steps that calculate beside steps that use devices."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.core.errors import CalibrationError
from controller.core.storage import write_atomically
from controller.run.journal import Journal
from controller.run.progress import Phase
from controller.run.runner import Context, Runner, Step
from controller.run.state_machine import Machine, State
from controller.run.step_id import StepId
from hal.deadline import Cancelled, Stop, in_seconds
from tests.controller.run.listening import Listening

LONG_S = 20


@pytest.fixture
def journal(tmp_path: Path) -> Iterator[Journal]:
    with Journal(tmp_path) as opened:
        yield opened


def step(
    name: str, do: Callable[[Context], object] = lambda context: None, *after: str, calculates: bool = False
) -> Step:
    def run(context: Context) -> Sequence[Path]:
        do(context)
        read = b"".join(context.paths(StepId(one))[0].read_bytes() for one in after)
        write_atomically(context.folder / name, name.encode() + read)
        return [context.folder / name]

    return Step(StepId(name), run, after=tuple(StepId(one) for one in after), calculates=calculates)


def until(event: threading.Event) -> Callable[[Context], None]:
    """Waits for it as a step that photographs does: it looks again and again whether it has to stop."""

    def wait(context: Context) -> None:
        while not event.wait(0.01):
            context.advance(0.5)

    return wait


def test_it_runs_while_the_next_step_photographs(journal: Journal) -> None:
    calculated, photographed = threading.Event(), threading.Event()

    def calculate(context: Context) -> None:
        until(photographed)(context)
        calculated.set()

    def photograph(context: Context) -> None:
        photographed.set()
        until(calculated)(context)

    steps = [step("first"), step("map", calculate, "first", calculates=True), step("codes", photograph)]
    results = Runner(steps, journal).run("test", deadline=in_seconds(LONG_S))
    assert [path.name for path in sorted(a[0].path for a in results.values())] == ["codes", "first", "map"]
    assert results[StepId("map")][0].path.read_bytes() == b"mapfirst"


def test_all_run_in_order_where_two_threads_may_not_calculate(
    journal: Journal, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_THREADING_LAYER", "workqueue")
    ended = threading.Event()

    def calculate(context: Context) -> None:
        time.sleep(0.05)
        ended.set()

    def photograph(context: Context) -> None:
        assert ended.is_set()

    steps = [step("map", calculate, calculates=True), step("codes", photograph)]
    assert len(Runner(steps, journal).run("test", deadline=in_seconds(LONG_S))) == 2


def test_a_step_that_reads_from_it_waits(journal: Journal) -> None:
    photographed, ended = threading.Event(), threading.Event()

    def calculate(context: Context) -> None:
        until(photographed)(context)
        ended.set()

    def shape(context: Context) -> None:
        assert ended.is_set()

    steps = [
        step("map", calculate, calculates=True),
        step("codes", lambda context: photographed.set()),
        step("shape", shape, "map"),
    ]
    results = Runner(steps, journal).run("test", deadline=in_seconds(LONG_S))
    assert results[StepId("shape")][0].path.read_bytes() == b"shapemap"


def test_nothing_runs_beside_where_no_step_uses_devices_afterwards(journal: Journal) -> None:
    threads = []
    steps = [step("codes"), step("map", lambda context: threads.append(threading.current_thread()), calculates=True)]
    Runner(steps, journal).run("test", deadline=in_seconds(LONG_S))
    assert threads == [threading.main_thread()]


def fails(context: Context) -> None:
    raise CalibrationError("projector-reaches-nothing", what="Nothing is seen.", remedy="Look at it.")


def test_its_error_stops_the_photographs(journal: Journal) -> None:
    machine = Machine(state=State.CALIBRATING)
    steps = [step("map", fails, calculates=True), step("codes", until(threading.Event()))]
    with pytest.raises(CalibrationError, match="Nothing is seen"):
        Runner(steps, journal, machine=machine).run("test", deadline=in_seconds(LONG_S))
    assert machine.reason == "Nothing is seen."
    assert journal.outcomes()[-1] == ("test", "projector-reaches-nothing")


def test_an_error_of_the_photographs_stops_it(journal: Journal) -> None:
    began, stopped = threading.Event(), []

    def calculate(context: Context) -> None:
        began.set()
        try:
            until(threading.Event())(context)
        except Cancelled:
            stopped.append(True)
            raise

    def photograph(context: Context) -> None:
        until(began)(context)
        fails(context)

    with pytest.raises(CalibrationError, match="Nothing is seen"):
        Runner([step("map", calculate, calculates=True), step("codes", photograph)], journal).run(
            "test", deadline=in_seconds(LONG_S)
        )
    assert stopped
    assert journal.latest(StepId("map")) is None


def test_a_request_to_stop_reaches_both(journal: Journal) -> None:
    stop, began, stopped = Stop(), threading.Event(), []

    def waits(name: str) -> Callable[[Context], None]:
        def wait(context: Context) -> None:
            began.set()
            try:
                until(threading.Event())(context)
            except Cancelled:
                stopped.append(name)
                raise

        return wait

    def photograph(context: Context) -> None:
        until(began)(context)
        stop.again()
        waits("codes")(context)

    with pytest.raises(Cancelled):
        Runner([step("map", waits("map"), calculates=True), step("codes", photograph)], journal).run(
            "test", deadline=in_seconds(LONG_S, stop)
        )
    assert sorted(stopped) == ["codes", "map"]


def test_a_calculation_that_does_not_notice_keeps_an_error_back_for_a_moment_only(
    journal: Journal, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("controller.run.background.PATIENCE_S", 0.2)
    began, released = threading.Event(), threading.Event()

    def deaf(context: Context) -> None:
        began.set()
        released.wait(LONG_S)

    def photograph(context: Context) -> None:
        until(began)(context)
        fails(context)

    at_s = time.monotonic()
    with pytest.raises(CalibrationError):
        Runner([step("map", deaf, calculates=True), step("codes", photograph)], journal).run(
            "test", deadline=in_seconds(LONG_S)
        )
    assert time.monotonic() - at_s < LONG_S / 2
    released.set()


def test_what_is_done_is_not_done_again(journal: Journal) -> None:
    calls: list[str] = []
    steps = [
        step("map", lambda context: calls.append("map"), calculates=True),
        step("codes", lambda context: calls.append("codes"), "map"),
    ]
    for _ in range(2):
        Runner(steps, journal).run("test", deadline=in_seconds(LONG_S))
    assert calls == ["map", "codes"]


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.booleans(), st.sets(st.integers(0, 9), max_size=3)), min_size=1, max_size=10))
def test_the_results_are_those_of_one_after_the_other(kinds: list[tuple[bool, set[int]]]) -> None:
    found, shown = [], Listening()
    for calculate in (False, True):
        steps = [
            step(f"s{n}", lambda context: context.advance(0.5), *(f"s{m}" for m in sorted(after) if m < n),
                 calculates=calculate and calculates)
            for n, (calculates, after) in enumerate(kinds)
        ]  # fmt: skip
        with TemporaryDirectory() as folder, Journal(Path(folder)) as journal:
            results = Runner(steps, journal, reporter=shown).run("test", deadline=in_seconds(LONG_S))
            found.append({str(name): one[0].sha256 for name, one in results.items()})
            fractions = [now.fraction for now in shown.told]
            assert fractions == sorted(fractions)
            assert fractions[-1] == pytest.approx(1)
            assert {now.index for now in shown.told if now.phase is Phase.DONE} == set(range(len(kinds)))
        shown.told.clear()
    assert found[0] == found[1]
