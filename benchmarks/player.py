"""The player as a kiosk runs it: a process of its own, three outputs in memory, a signed-for bundle, another reader."""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks import Row, at_least, at_most
from benchmarks._synthetic import PROJECTOR
from benchmarks._watch import digest
from controller.arrays import ByteImage
from controller.bundle.writer import NewAppearance, write_bundle
from controller.play.launch import PlayerProcess, PlayerSettings, start_player
from hal.deadline import in_seconds
from hal.registry import OpenContext
from plugins.player_display import DRIVER, PlayerDisplay

OUTPUTS = ("P1", "P2", "P3")
APPEARANCES = 4
STARTS = 5
SUSTAINED_S = 20.0
PACED_S = 10.0
FEWEST_WATCHED = 2000
AS_FAST_HZ = 1000.0


def measure(size: str) -> list[Row]:
    """Start, imports, swaps as fast as they go, pacing at 30 and 60 Hz, memory, and whole sets seen from outside."""
    paper = size == "paper"
    with tempfile.TemporaryDirectory(prefix="velatura-bench-") as folder:
        place = Path(folder)
        swaps = _frames(size)
        settings = _settings(place, swaps)
        rows = [_imports(), _starting(place, settings)]
        with start_player(place, settings) as player:
            display = DRIVER.open({"socket": "player.sock"}, OpenContext(stage=place), in_seconds(20))
            assert isinstance(display, PlayerDisplay)
            try:
                rows += _sustained(display, paper=paper)
                rows += [row for rate_hz in (30.0, 60.0) for row in _paced(display, rate_hz)]
                rows.append(_watched(display, place, swaps))
                rows += _memory(player, display, settings)
            finally:
                display.close()
    return rows


def _frames(size: str) -> list[dict[str, ByteImage]]:
    """Dithered-looking frames: smooth pictures with a little noise."""
    rows, columns = PROJECTOR[size]
    rng = np.random.default_rng(0)
    y, x = np.mgrid[0:rows, 0:columns].astype(np.float32)
    found = []
    for number in range(APPEARANCES):
        smooth = 128 + 90 * np.sin(x / (30 + 7 * number)) * np.cos(y / (23 + 5 * number))
        picture = np.repeat(smooth[..., None], 3, axis=2)
        found.append({name: (picture + rng.integers(0, 3, picture.shape)).astype(np.uint8) for name in OUTPUTS})
    return found


def _settings(place: Path, swaps: Sequence[dict[str, ByteImage]]) -> PlayerSettings:
    rows, columns, _ = swaps[0][OUTPUTS[0]].shape
    outputs = [(name, columns, rows) for name in OUTPUTS]
    bundle = place / "bundle.vel"
    write_bundle(bundle, stage="benchmark", calibration="benchmark", created_unix_s=0, outputs=outputs,
                 appearances=(NewAppearance(f"a{n}", frames) for n, frames in enumerate(swaps)))  # fmt: skip
    return PlayerSettings(outputs, frames=place / "outputs.frame", bundle=bundle, allow_unsigned=True)


def _imports() -> Row:
    def seconds(module: str) -> float:
        began = time.perf_counter()
        subprocess.run([sys.executable, "-c", f"import {module}"], check=True)
        return time.perf_counter() - began

    seconds("controller.play.__main__")
    plain = statistics.median(seconds("sys") for _ in range(STARTS))
    ours = statistics.median(seconds("controller.play.__main__") for _ in range(STARTS))
    how = f"median of {STARTS} processes; Python alone takes {1000 * plain:.0f} ms more"
    return at_most("imports", 1000 * (ours - plain), 150.0, unit="ms", how=how)


def _starting(place: Path, settings: PlayerSettings) -> Row:
    """From the start of the process to an appearance of the bundle in the memory output."""
    times = []
    for _ in range(STARTS):
        began = time.perf_counter()
        with start_player(place, settings):
            display = DRIVER.open({"socket": "player.sock"}, OpenContext(stage=place), in_seconds(20))
            display.play("a0", deadline=in_seconds(20))
            times.append(time.perf_counter() - began)
            display.close()
    how = f"min {min(times):.2f}, max {max(times):.2f} over {STARTS}: process, bundle checked, first appearance shown"
    return at_most("start to first picture", statistics.median(times), 0.7, unit="s", how=how)


def _sustained(display: PlayerDisplay, *, paper: bool) -> list[Row]:
    _play(display, AS_FAST_HZ)
    time.sleep(1.0)
    before, began = display.playing(deadline=in_seconds(5)), time.perf_counter()
    time.sleep(SUSTAINED_S)
    after, elapsed = display.playing(deadline=in_seconds(5)), time.perf_counter() - began
    assert after.interval_p50_s is not None
    assert after.interval_p99_s is not None
    rate = (after.swaps - before.swaps) / elapsed
    goal = 120.0 if paper else None
    how = f"as fast as they go for {elapsed:.0f} s, {APPEARANCES} appearances decoded in turn"
    return [
        at_least("swaps sustained", rate, goal, unit="a second", how=how),
        at_most("interval, p50 and p99", 1000 * after.interval_p99_s, None, unit="ms p99",
                how=f"p50 {1000 * after.interval_p50_s:.2f} ms"),
    ]  # fmt: skip


def _paced(display: PlayerDisplay, rate_hz: float) -> list[Row]:
    _play(display, rate_hz)
    time.sleep(PACED_S)
    found = display.playing(deadline=in_seconds(5))
    assert found.interval_p50_s is not None
    assert found.interval_p99_s is not None
    tick_ms = 1000 / rate_hz
    how = f"p50 {1000 * found.interval_p50_s:.2f} ms of {tick_ms:.2f}; {found.late} late in {PACED_S:g} s"
    goal = 34.5 if rate_hz == 30.0 else None
    return [at_most(f"interval at {rate_hz:g} Hz", 1000 * found.interval_p99_s, goal, unit="ms p99", how=how)]


def _watched(display: PlayerDisplay, place: Path, swaps: Sequence[dict[str, ByteImage]]) -> Row:
    """Another process reads while at least ``FEWEST_WATCHED`` swaps pass."""
    black = {name: np.zeros_like(frame) for name, frame in swaps[0].items()}
    known = [digest(frames) for frames in (*swaps, black)]
    _play(display, AS_FAST_HZ)
    before = display.playing(deadline=in_seconds(5)).swaps
    time.sleep(2.0)
    rate = (display.playing(deadline=in_seconds(5)).swaps - before) / 2.0
    seconds = max(10.0, 2.0 * FEWEST_WATCHED / max(rate, 1.0))
    command = [sys.executable, "-m", "benchmarks._watch", str(place / "outputs.frame"), f"{seconds:.1f}", *known]
    ended = subprocess.run(command, stdout=subprocess.PIPE, check=True, text=True)
    found = json.loads(ended.stdout.splitlines()[-1])
    how = f"{found['passed']} swaps in {seconds:.0f} s, {found['read']} sets read whole by another process"
    return at_most("swaps that mix two appearances", float(found["mixed"]), 0.0, unit="", how=how)


def _memory(player: PlayerProcess, display: PlayerDisplay, settings: PlayerSettings) -> list[Row]:
    """Resident memory, what is mapped apart, and its growth over as many swaps again as were shown until now."""
    _play(display, AS_FAST_HZ)
    first, begin = _anonymous_bytes(player.pid), display.playing(deadline=in_seconds(5)).swaps
    time.sleep(SUSTAINED_S)
    last, status = _anonymous_bytes(player.pid), display.playing(deadline=in_seconds(5))
    mapped = status.rss_bytes - last
    passed = status.swaps - begin
    return [
        at_most("memory beyond the mapped files", last / 1e6, 200.0, unit="MB",
                how=f"private and anonymous; {mapped / 1e6:.0f} MB of mapped files are resident beside it"),
        at_most("memory, growth", (last - first) / 1e6, 0.0, unit="MB",
                how=f"over {passed} swaps, after {begin}; pages come and go by a few hundred kB"),
    ]  # fmt: skip


def _anonymous_bytes(pid: int) -> int:
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("RssAnon:")).split()[1]) * 1024


def _play(display: PlayerDisplay, rate_hz: float) -> None:
    items = [(f"a{number}", 1 / rate_hz) for number in range(APPEARANCES)]
    display.play_sequence(items, deadline=in_seconds(20), rate_hz=rate_hz)
