"""The live loop: newest first, late ones counted, stops at once, and the real player at its end."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from controller.core.errors import UsageError
from controller.optics.solve.appearance import base_image, solve_base
from controller.optics.solve.scaling.interactive import interactive
from controller.optics.transport import build_transport
from controller.stage.live import LivePicture
from controller.stage.steps.appearance import live
from controller.stage.steps.appearance.live import FrameMaker, Frames, LiveFigures, TargetMaker, run_live
from lab.timings.tools.synthetic import synthetic_calibration

CALIBRATION = synthetic_calibration(projector=(34, 40), camera=(96, 120))


@pytest.fixture(scope="module")
def maker() -> FrameMaker:
    transport = build_transport(CALIBRATION)
    base = solve_base(transport, base_image(CALIBRATION), CALIBRATION.black)
    scaler = interactive(transport, base, CALIBRATION.black, [part.radiometry for part in CALIBRATION.projectors])
    made = FrameMaker(scaler, 0.3)
    made.make(LivePicture(np.zeros((48, 60, 3), np.uint8), 0, 0), made.blank())
    return made


class Numbers:
    """A source of ``count`` grey pictures, one each time it is asked; ``fails_at`` one of them."""

    def __init__(self, count: int, *, fails_at: int = -1) -> None:
        self.count, self.fails_at, self.at, self.closed = count, fails_at, 0, False

    def next(self, at_s: float) -> LivePicture | None:
        self.at += 1
        if self.at == self.fails_at:
            raise UsageError("target-unreadable", what="Damaged.", remedy="Write it again.")
        return LivePicture(np.full((48, 60, 3), 20 + self.at, np.uint8), self.at - 1, 0)

    @property
    def ended(self) -> bool:
        return self.at >= self.count

    def close(self) -> None:
        self.closed = True


class Patient(Numbers):
    """Has its next picture when the previous one was shown, however long that takes on a busy machine."""

    def __init__(self, count: int, *, fails_at: int = -1) -> None:
        super().__init__(count, fails_at=fails_at)
        self.seen: list[Frames] = []

    def show(self, frames: Frames) -> None:
        self.seen.append([frame.copy() for frame in frames])

    def next(self, at_s: float) -> LivePicture | None:
        failed = 0 < self.fails_at <= self.at
        return super().next(at_s) if self.at == len(self.seen) + failed else None


def test_every_picture_of_a_slow_source_is_shown_in_order(maker: FrameMaker) -> None:
    source = Patient(12)
    figures = run_live(source, maker, source.show, rate_hz=40)
    seen = [_level(frames) for frames in source.seen]
    assert figures.made == 12
    assert figures.late == 0
    assert seen == sorted(seen)
    assert len(set(seen)) > 6
    assert source.closed


def test_a_slow_display_drops_what_came_too_late_and_counts_it(maker: FrameMaker) -> None:
    source = Numbers(40)
    figures = run_live(source, maker, lambda frames: time.sleep(0.08), rate_hz=100)
    assert figures.made + figures.late == 40
    assert figures.late > 10
    told = figures.as_json()
    assert told["pictures_per_s"] < 14
    assert told["delay_p50_ms"] > 0


def test_a_stop_takes_hold_and_leaves_no_thread(maker: FrameMaker) -> None:
    class Stopped(Exception):
        pass

    def report(figures: LiveFigures) -> None:
        raise Stopped

    source = Numbers(10**6)
    before = threading.active_count()
    with pytest.raises(Stopped):
        run_live(source, maker, lambda frames: None, rate_hz=50, report=report)
    assert source.closed
    assert threading.active_count() == before


def test_a_bad_picture_is_passed_over_and_told_of(maker: FrameMaker) -> None:
    source = Patient(9, fails_at=3)
    figures = run_live(source, maker, source.show, rate_hz=100)
    assert (figures.made, figures.bad) == (8, 1)
    assert figures.as_json()["trouble"] == "Damaged. Write it again."


def test_targets_are_handed_on_at_their_size() -> None:
    source = Patient(3)
    run_live(source, TargetMaker((30, 24)), source.show, rate_hz=99)
    seen = [(frames[0].shape, _level(frames)) for frames in source.seen]
    assert seen == [((24, 30, 3), 21), ((24, 30, 3), 22), ((24, 30, 3), 23)]


def test_a_display_that_fails_ends_it_with_the_error(maker: FrameMaker) -> None:
    def broken(frames: Frames) -> None:
        raise OSError("gone")

    source = Numbers(10**6)
    with pytest.raises(OSError, match="gone"):
        run_live(source, maker, broken, rate_hz=100)
    assert source.closed


def test_a_picture_that_comes_with_the_end_is_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    there = threading.Event()
    seen: list[int] = []
    take = live._Mailbox.take

    class Last(Numbers):
        def next(self, at_s: float) -> LivePicture | None:
            assert there.wait(30)
            return super().next(at_s)

    def take_too_early(box: live._Mailbox, timeout_s: float) -> tuple[Frames, float, int] | None:
        """Finds nothing, and by the time that is known, the last picture is there and the source has ended."""
        found = take(box, 0.0)
        there.set()
        while found is None and not box.ended:
            time.sleep(0.001)
        return found

    monkeypatch.setattr(live._Mailbox, "take", take_too_early)
    run_live(Last(1), TargetMaker((30, 24)), lambda frames: seen.append(_level(frames)), rate_hz=100)
    assert seen == [21]


def test_a_run_of_months_keeps_no_more_of_its_delays_than_it_tells_of() -> None:
    class Small:
        def blank(self) -> Frames:
            return [np.zeros((1, 1, 3), np.uint8)]

        def make(self, picture: LivePicture, into: Frames) -> None:
            """Any picture will do."""

    shown = threading.Semaphore(1)

    class Prompt(Numbers):
        def next(self, at_s: float) -> LivePicture | None:
            assert shown.acquire(timeout=30)
            self.at += 1
            return LivePicture(np.zeros((1, 1, 3), np.uint8), self.at - 1, 0)

    figures = run_live(Prompt(4200), Small(), lambda frames: shown.release(), rate_hz=1e6)
    assert figures.made == 4200
    assert len(figures.delays_s) == 4096
    assert figures.as_json()["delay_p99_ms"] > 0


def test_it_ends_after_the_time_that_was_asked_for(maker: FrameMaker) -> None:
    began_s = time.monotonic()
    figures = run_live(Numbers(10**6), maker, lambda frames: None, rate_hz=30, seconds=2)
    assert 2 <= time.monotonic() - began_s < 10
    assert 32 <= figures.made <= 61


def _level(frames: Frames) -> int:
    return int(sum(int(frame.max()) for frame in frames))
