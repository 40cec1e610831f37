from __future__ import annotations

import pytest

from controller.run.progress import Phase, Tracker
from tests.controller.run.listening import Listening


class Hands:
    """A clock that is moved by hand."""

    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def test_time_left_follows_the_measured_rate_not_the_expected_one() -> None:
    reporter, clock = Listening(), Hands()
    tracker = Tracker(["a", "b"], [1.0, 3.0], reporter, clock)
    tracker.begin(0)
    assert reporter.told[-1].left_s is None
    clock.now_s += 10  # ten times slower than the weight says
    tracker.end()
    assert reporter.told[-1].left_s == pytest.approx(30)
    tracker.begin(1)
    clock.now_s += 5
    tracker.advance(1 / 3)  # twice as fast as the step before
    assert reporter.told[-1].left_s == pytest.approx(15 / 2 * 2)
    assert reporter.told[-1].fraction == pytest.approx(0.5)


def test_a_skipped_step_counts_as_progress_but_not_as_speed() -> None:
    reporter, clock = Listening(), Hands()
    tracker = Tracker(["a", "b", "c"], [8.0, 1.0, 1.0], reporter, clock)
    tracker.skip(0)
    assert reporter.told[-1].phase is Phase.SKIPPED
    assert reporter.told[-1].fraction == pytest.approx(0.8)
    assert reporter.told[-1].left_s is None
    tracker.begin(1)
    clock.now_s += 7
    tracker.end()
    assert reporter.told[-1].left_s == pytest.approx(7)


def test_progress_never_runs_backwards_and_ends_at_one() -> None:
    reporter, clock = Listening(), Hands()
    tracker = Tracker(["a", "b"], [1.0, 1.0], reporter, clock)
    for step in range(2):
        tracker.begin(step)
        for fraction in (0.5, 0.2, 7.0):
            clock.now_s += 1
            tracker.advance(fraction)
        tracker.end()
    fractions = [now.fraction for now in reporter.told]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0
    assert reporter.told[-1].left_s == 0.0


@pytest.mark.parametrize("weights", [[1.0], [1.0, 0.0], [1.0, float("nan")]])
def test_steps_without_a_sensible_weight_are_refused(weights: list[float]) -> None:
    with pytest.raises(ValueError, match="weight above zero"):
        Tracker(["a", "b"], weights, Listening())
