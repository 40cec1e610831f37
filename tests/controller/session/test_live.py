"""The live loop: newest first, late ones counted, stops at once, and the real player at its end."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping

import numpy as np
import pytest

from benchmarks._synthetic import synthetic_calibration
from controller.arrays import ByteImage
from controller.errors import UsageError
from controller.live.scaling import LiveScaler
from controller.live.sources import LivePicture
from controller.session.live import LiveFigures, run_live
from controller.solve.appearance import base_image, solve_base
from controller.transport import LightTransport

CALIBRATION = synthetic_calibration(projector=(34, 40), camera=(96, 120))


@pytest.fixture(scope="module")
def scaler() -> LiveScaler:
    transport = LightTransport.build(CALIBRATION)
    base = solve_base(transport, base_image(CALIBRATION), CALIBRATION.black)
    made = LiveScaler(CALIBRATION, transport, base, exposure=0.3)
    made.frames(np.zeros((48, 60, 3), np.uint8), made.blank())
    return made


class Numbers:
    """A source of ``count`` grey pictures, one each time it is asked; ``fails_at`` one of them."""

    def __init__(self, count: int, *, fails_at: int = -1) -> None:
        self.count, self.fails_at, self.at, self.closed = count, fails_at, 0, False

    def next(self, at_s: float) -> LivePicture | None:
        if self.at == self.fails_at:
            raise UsageError("target-unreadable", what="Damaged.", remedy="Write it again.")
        self.at += 1
        return LivePicture(np.full((48, 60, 3), 20 + self.at, np.uint8), self.at - 1, 0)

    @property
    def ended(self) -> bool:
        return self.at >= self.count

    def close(self) -> None:
        self.closed = True


def test_every_picture_of_a_slow_source_is_shown_in_order(scaler: LiveScaler) -> None:
    seen: list[int] = []
    source = Numbers(12)
    figures = run_live(source, scaler, lambda frames: seen.append(_level(frames)), rate_hz=40)
    assert figures.shown == 12
    assert figures.late == 0
    assert seen == sorted(seen)
    assert len(set(seen)) > 6
    assert source.closed


def test_a_slow_display_drops_what_came_too_late_and_counts_it(scaler: LiveScaler) -> None:
    source = Numbers(40)
    figures = run_live(source, scaler, lambda frames: time.sleep(0.08), rate_hz=100)
    assert figures.shown + figures.late == 40
    assert figures.late > 10
    told = figures.told()
    assert told["pictures_per_s"] < 14
    assert told["delay_p50_ms"] > 0


def test_a_stop_takes_hold_and_leaves_no_thread(scaler: LiveScaler) -> None:
    class Stopped(Exception):
        pass

    def tell(figures: LiveFigures) -> None:
        raise Stopped

    source = Numbers(10**6)
    before = threading.active_count()
    with pytest.raises(Stopped):
        run_live(source, scaler, lambda frames: None, rate_hz=50, tell=tell)
    assert source.closed
    assert threading.active_count() == before


def test_a_source_or_a_display_that_fails_ends_it_with_the_error(scaler: LiveScaler) -> None:
    with pytest.raises(UsageError):
        run_live(Numbers(9, fails_at=3), scaler, lambda frames: None, rate_hz=100)

    def broken(frames: Mapping[str, ByteImage]) -> None:
        raise OSError("gone")

    source = Numbers(10**6)
    with pytest.raises(OSError, match="gone"):
        run_live(source, scaler, broken, rate_hz=100)
    assert source.closed


def test_it_ends_after_the_time_that_was_asked_for(scaler: LiveScaler) -> None:
    began_s = time.monotonic()
    figures = run_live(Numbers(10**6), scaler, lambda frames: None, rate_hz=30, seconds=0.5)
    assert 0.4 < time.monotonic() - began_s < 1.5
    assert 8 <= figures.shown <= 16


def _level(frames: Mapping[str, ByteImage]) -> int:
    return int(sum(int(frame.max()) for frame in frames.values()))
