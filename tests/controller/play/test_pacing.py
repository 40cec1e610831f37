"""When pictures become visible: by the monotonic clock alone, at the ticks of the rate, whatever else happens."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.bundle.reader import Bundle
from controller.bundle.signing import ANY_SIGNER
from controller.play import cache, presenting
from controller.play import presenting as pacing
from controller.play.frames import FrameSet, OutputSize
from controller.play.presenting import PendingPresentation, Presenter
from tests.controller.play.conftest import OUTPUTS, write_noise
from tests.controller.play.wire import Wire, noise
from tests.waiting import eventually

SIZES = (OutputSize("P1", 2, 2),)
RATE_HZ = 30.0


@dataclass
class Clocks:
    """Stands for the module ``time``: the monotonic clock goes by sleeping and by work, the wall clock jumps."""

    now_s: float = 1000.0
    wall_s: float = 0.0

    def monotonic(self) -> float:
        return self.now_s

    def time(self) -> float:
        self.wall_s = -self.wall_s - 1e9
        return self.wall_s

    def sleep(self, seconds: float) -> None:
        assert seconds >= 0
        self.now_s += seconds


@dataclass
class Slow:
    """An output whose preparing takes as long as ``takes_s`` says, once each."""

    clocks: Clocks
    takes_s: list[float] = field(default_factory=list)
    flips_s: list[float] = field(default_factory=list)

    def prepare(self, frames: FrameSet) -> None:
        self.clocks.now_s += self.takes_s.pop(0) if self.takes_s else 0.002

    def load_fade(self, before: FrameSet, after: FrameSet) -> None:
        self.clocks.now_s += 0.001

    def mix(self, share: float) -> None:
        self.prepare(FrameSet(()))

    def flip(self) -> float:
        self.flips_s.append(self.clocks.now_s)
        return self.clocks.now_s

    continued = False

    def leave(self) -> None:
        """No one follows."""

    def missing(self) -> tuple[str, ...]:
        return ()

    def pump(self) -> None: ...

    def close(self) -> None: ...


@pytest.fixture
def clocks(monkeypatch: pytest.MonkeyPatch) -> Clocks:
    found = Clocks()
    for module in (presenting, pacing):
        monkeypatch.setattr(module, "time", found)
    return found


def play(presenter: Presenter, clocks: Clocks, count: int) -> None:
    """Present ``count`` sets, each at the tick after the previous one, looking as often as the player's loop does."""
    black = FrameSet.black(SIZES)
    presenter.begin_sequence(RATE_HZ)
    tick = presenter.soon()
    for _ in range(count):
        coming = PendingPresentation("appearance", "a", black, tick, None, paced=True)
        while not presenter.present(coming, black):
            clocks.sleep(max(presenter.patience_s(coming), 0.0001))
        tick = coming.first_tick + 1


def test_every_picture_comes_at_its_tick(clocks: Clocks) -> None:
    output = Slow(clocks)
    presenter = Presenter(output, SIZES, RATE_HZ)
    play(presenter, clocks, 1000)
    # How long preparing takes is known from the second on.
    ticks = np.array(output.flips_s[1:]) * RATE_HZ
    np.testing.assert_allclose(np.diff(ticks), 1, atol=1e-6)
    np.testing.assert_allclose(ticks, np.round(ticks), atol=1e-6)
    assert presenter.late == 0
    assert presenter.intervals.percentile(99) == pytest.approx(1 / RATE_HZ, rel=3e-4)


def test_a_picture_that_is_late_is_counted_once_and_the_next_are_on_the_grid_again(clocks: Clocks) -> None:
    output = Slow(clocks, takes_s=[0.002] * 10 + [0.12] + [0.002] * 100)
    presenter = Presenter(output, SIZES, RATE_HZ)
    play(presenter, clocks, 60)
    assert presenter.late == 1
    ticks = np.array(output.flips_s) * RATE_HZ
    steps = np.diff(ticks)
    assert 3 < steps.max() < 5
    np.testing.assert_allclose(steps[12:], 1, atol=1e-6)
    np.testing.assert_allclose(ticks[12:], np.round(ticks[12:]), atol=1e-6)


@pytest.mark.parametrize(("awaited", "paced", "late"), [(False, True, 1), (True, True, 0), (False, False, 0)])
def test_late_counts_the_pictures_of_a_sequence_that_nobody_asks_for(
    clocks: Clocks, *, awaited: bool, paced: bool, late: int
) -> None:
    presenter = Presenter(Slow(clocks, takes_s=[0.12]), SIZES, RATE_HZ)
    black = FrameSet.black(SIZES)
    results: list[object] = []
    presenter.begin_sequence(RATE_HZ)
    asked = results.append if awaited else None
    coming = PendingPresentation("appearance", "a", black, presenter.soon(), asked, paced=paced)
    assert presenter.present(coming, black, wait=True)
    assert presenter.late == late


@pytest.mark.parametrize("moment_s", [0.0, 1 / 3, 1000.0, 1000.001, 12345.6789, 12345.7])
@pytest.mark.parametrize("rate_hz", [1.0, 24.0, RATE_HZ, 59.94])
def test_a_tick_is_the_first_that_is_not_before_the_moment(moment_s: float, rate_hz: float) -> None:
    grid = presenting.Grid(rate_hz)
    tick = grid.after(moment_s)
    assert grid.at_s(tick - 1) < moment_s - 1e-9 or tick == 0
    assert grid.at_s(tick) >= moment_s - 1e-9
    assert (grid.ticks(0), grid.ticks(2.4 / rate_hz), grid.ticks(2.6 / rate_hz)) == (1, 2, 3)


def test_a_set_that_is_held_keeps_its_pixels_while_all_others_are_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cache, "CACHE_BYTES", 0)
    sizes = [OutputSize(*one) for one in OUTPUTS]
    decoded = cache.DecodedAhead(Bundle.open_trusted(write_noise(tmp_path / "b.vel"), ANY_SIGNER), sizes, lambda: None)
    held: list[FrameSet] = []
    for name in "0123450123451":
        decoded.want([name])
        assert eventually(partial(decoded.take, name), every_s=0.001)
        frames = decoded.take(name)
        assert frames is not None
        if len(held) < 2:  # as while one fades in over the other
            held.append(frames)
            decoded.hold(*held)
        for seed, kept in enumerate(held):
            expected = noise(OUTPUTS, seed).values()
            assert all(np.array_equal(a, b) for a, b in zip(kept.pixels, expected, strict=True))
    decoded.close()


def test_a_fade_takes_its_time_however_slow_its_steps_are(clocks: Clocks) -> None:
    for takes_s in (0.002, 0.08):
        output = Slow(clocks, takes_s=[takes_s] * 200)
        presenter = Presenter(output, SIZES, RATE_HZ)
        black = FrameSet.black(SIZES)
        coming = PendingPresentation("appearance", "a", black, presenter.soon(), None, fade_s=2.0)
        while not presenter.present(coming, black):
            clocks.sleep(max(presenter.patience_s(coming), 0.0001))
        assert output.flips_s[-1] - output.flips_s[0] == pytest.approx(2.0, abs=0.15)
        assert presenter.shown is black


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(1e-5, 3e7), min_size=1, max_size=300), st.sampled_from([1, 50, 99, 100]))
def test_percentiles_of_any_number_of_intervals_are_those_of_a_sorted_list(seconds: list[float], percent: int) -> None:
    intervals = pacing.Intervals()
    for interval in seconds:
        intervals.add(interval)
    rank = max(1, -(-percent * len(seconds) // 100))
    assert intervals.percentile(percent) == pytest.approx(sorted(seconds)[rank - 1], rel=3e-4)


def test_intervals_beyond_all_classes_are_counted_in_the_nearest() -> None:
    intervals = pacing.Intervals()
    assert intervals.percentile(50) is None
    for interval in (0.0, -1.0, 1e12):
        intervals.add(interval)
    assert intervals.percentile(1) == pytest.approx(1e-5, rel=1e-3)
    assert 3e7 < (intervals.percentile(100) or 0) < 1e8


@contextmanager
def deceived_player(folder: Path) -> Iterator[Path]:
    """The socket of a player in a process whose wall clock jumps."""
    outputs = ",".join(f"{name}:{width}x{height}" for name, width, height in OUTPUTS)
    command = [sys.executable, "-m", "tests.controller.play.jumping_clock", "--socket", str(folder / "s")]
    command += ["--outputs", outputs, "--frames", str(folder / "out.frame"), "--allow-unsigned"]
    with (folder / "log").open("wb") as log:
        player = subprocess.Popen([*command, "--bundle", str(write_noise(folder / "b.vel"))], stdout=log, stderr=log)
    try:
        ends = time.monotonic() + 20
        while not (folder / "s").exists() and player.poll() is None and time.monotonic() < ends:
            time.sleep(0.02)
        assert player.poll() is None, (folder / "log").read_text()
        yield folder / "s"
        player.terminate()
        assert player.wait(10) == 0, (folder / "log").read_text()
    finally:
        player.kill()
        player.wait()


def test_a_wall_clock_that_is_set_back_and_forward_moves_no_picture(tmp_path: Path) -> None:
    with deceived_player(tmp_path) as path, Wire(path) as wire:
        first = wire.ask("sequence", items=[[str(seed), 0.04] for seed in range(6)], repeat=5, rate_hz=50)
        ends = time.monotonic() + 30
        while (status := wire.ask("status"))["sequence_running"] and time.monotonic() < ends:
            time.sleep(0.05)
        assert status["sequence"] - first["sequence"] == 29
        assert status["presented_at"] - first["presented_at"] >= 29 * 0.04 - 0.02, "nothing comes before its time"
        faded = wire.ask("play", appearance="2", fade_s=0.5)
        assert 0.4 < faded["presented_at"] - status["presented_at"] < 20
