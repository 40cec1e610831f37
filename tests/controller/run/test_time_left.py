"""The time left: from what the last runs took, without jumps that no one explains."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.run.journal import Journal
from controller.run.progress import RISE, SLACK_S, Tracker
from controller.run.runner import Context, Runner, Step, measured
from controller.run.step_id import StepId
from hal.deadline import in_seconds
from tests.controller.run.listening import Listening
from tests.controller.run.test_progress import Hands

SECONDS = st.floats(0.1, 3600)


@given(st.lists(st.tuples(SECONDS, st.floats(0.2, 5.0)), min_size=1, max_size=12))
def test_it_never_rises_by_more_than_a_fifth_without_a_reason(steps: list[tuple[float, float]]) -> None:
    reporter, clock = Listening(), Hands()
    before = [seconds for seconds, _ in steps]
    tracker = Tracker([f"step {n}" for n in range(len(steps))], [1.0] * len(steps), reporter, clock, before)
    for number, (seconds, slower) in enumerate(steps):
        tracker.begin(number)
        for part in (0.25, 0.5, 0.75, 1.0):
            clock.now_s += seconds * slower / 4
            tracker.advance(part)
        tracker.end()
    least = float("inf")
    for now in reporter.told:
        assert now.left_s is not None, "known from the first moment"
        assert now.left_s <= RISE * least + SLACK_S or "takes longer than in the last runs" in now.why
        least = min(least, now.left_s)
    assert reporter.told[-1].left_s == 0.0
    if all(0.95 <= slower <= 1.05 for _, slower in steps):
        total, began_s = sum(before), clock.now_s - sum(seconds * slower for seconds, slower in steps)
        for now in reporter.told:
            assert now.left_s is not None
            assert abs(now.left_s - (total - now.elapsed_s)) <= 0.1 * total + 0.1
        assert began_s == pytest.approx(Hands.now_s, abs=1e-6)


def test_without_a_measured_run_it_says_nothing_until_it_can_know() -> None:
    reporter, clock = Listening(), Hands()
    tracker = Tracker(["a", "b"], [1.0, 99.0], reporter, clock)
    tracker.begin(0)
    clock.now_s += 3
    tracker.advance(0.5)
    tracker.end()
    assert {now.left_s for now in reporter.told} == {None}, "one per cent of the work says nothing about the rest"
    tracker.begin(1)
    clock.now_s += 100
    tracker.advance(0.2)
    assert reporter.told[-1].left_s is not None


def test_a_second_run_of_the_same_kind_knows_from_its_first_moment_how_long_it_takes(tmp_path: Path) -> None:
    def work(context: Context) -> list[Path]:
        time.sleep(0.2)
        return []

    steps = [Step(StepId("capture", "left"), work), Step(StepId("appearance", item="a"), work, weight=500.0)]
    for name in ("20260101-020000-calibrate", "20260102-020000-calibrate", "20260103-020000-drift"):
        reporter = Listening()
        with Journal(tmp_path / "runs" / name) as journal:
            Runner(steps, journal, reporter=reporter).run("r", deadline=in_seconds(60, threading.Event()))
        if name.startswith("20260102"):
            assert reporter.told[0].left_s is not None
            assert 0.3 < reporter.told[0].left_s < 3.0
        else:
            assert reporter.told[0].left_s is None, "another kind of run, or the first"
    new = measured(tmp_path / "runs" / "20260104-020000-calibrate", [StepId("appearance", item="new"), StepId("other")])
    assert new[0] is not None
    assert 0.15 < new[0] < 3.0
    assert new[1] is None
