"""The player as a kiosk runs it: a process of its own, outputs in memory, a signed-for bundle, another reader.

Size uhd: four outputs of 3840x2160. ``BENCH_MINUTES`` says for how long 30 Hz is played (10 for the goal; else 10 s).
"""

from __future__ import annotations

import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from controller.bundle.writer import NewAppearance, NewBundle, write_bundle
from controller.core.arrays import ByteImage
from controller.play.cache import CACHE_BYTES
from controller.play.control.launch import PlayerProcess, PlayerSettings, start_player
from hal.deadline import in_seconds
from hal.registry import OpenContext
from lab.timings import SIZES as BASE_SIZES
from lab.timings import Row, at_least, at_most
from lab.timings.tools.frames import UHD, compensation_frames
from lab.timings.tools.watch import digest
from plugins.display.player import DRIVER, PlayerDisplay

SIZES = (*BASE_SIZES, UHD)
RESIDENT = 3
"""So few are decoded once and stay."""
BEYOND_CACHE = 4
MOST_CACHED = 64
STARTS = 5
SUSTAINED_S = 20.0
PACED_S = 10.0
FADED_S = 5.0
FADED_HZ = 60.0
FEWEST_WATCHED = 2000
WATCHED_HZ = 60.0
WATCHED_S = 120.0
AS_FAST_HZ = 1000.0
MANY_SWAPS = 100_000


def measure(size: str) -> list[Row]:
    """Start, imports, swaps as fast as they go, pacing at 30 and 60 Hz, memory, and whole sets seen from outside."""
    paper = size == "paper"
    keep_compiled()
    with tempfile.TemporaryDirectory(prefix="velatura-bench-") as folder:
        place = Path(folder)
        swaps = _frames(size)
        settings = _settings(place, swaps)
        rows = [_imports(), starting(place, settings)]
        with start_player(place, settings) as player:
            display = DRIVER.open({}, OpenContext(stage=place, runtime=place), in_seconds(20))
            assert isinstance(display, PlayerDisplay)
            try:
                rows += _sustained(display, len(swaps), paper=paper)
                rows += [row for rate_hz in (30.0, 60.0) for row in _paced(display, rate_hz, len(swaps), player.pid)]
                rows.append(_fading(display))
                rows.append(_watched(display, place, swaps))
                rows += _memory(player, display, len(swaps))
            finally:
                display.close()
    return rows


def _frames(size: str) -> list[dict[str, ByteImage]]:
    """Solved, dithered frames, shifted against each other: more sets than the player's cache holds.

    With fewer, nothing is decoded after the first round, and the rate is that of copying alone.
    """
    (solved,) = compensation_frames(size, 1)
    set_bytes = sum(frame.nbytes for frame in solved.values())
    sets = more_than_kept(set_bytes)
    return [{name: np.roll(frame, 3 * number, axis=1) for name, frame in solved.items()} for number in range(sets)]


def more_than_kept(set_bytes: int) -> int:
    """So many sets that a player which shows them in turn decodes each one again."""
    return min(MOST_CACHED, CACHE_BYTES // set_bytes) + BEYOND_CACHE


def _settings(place: Path, swaps: Sequence[dict[str, ByteImage]]) -> PlayerSettings:
    outputs = [(name, frame.shape[1], frame.shape[0]) for name, frame in swaps[0].items()]
    bundle = place / "bundle.vel"
    write_bundle(
        bundle,
        NewBundle(stage="timing", calibration="timing", created_unix_s=0, outputs=outputs),
        appearances=(NewAppearance(f"a{n}", frames) for n, frames in enumerate(swaps)),
    )
    return PlayerSettings(outputs, frames=place / "outputs.frame", bundle=bundle, allow_unsigned=True)


def keep_compiled() -> None:
    """Let Python keep compiled modules: a kiosk has them, and without them every start compiles again."""
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)


def _imports() -> Row:
    def seconds(module: str) -> tuple[float, float]:
        """Wall and processor time."""
        began, used = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, "-c", f"import {module}"], check=True, env=environment)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        cpu = after.ru_utime + after.ru_stime - used.ru_utime - used.ru_stime
        return time.perf_counter() - began, cpu

    # As launch.py and the service's unit start it.
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    seconds("controller.play.__main__")
    plain, numpy, ours = (
        [1000 * float(value) for value in np.median([seconds(module) for _ in range(STARTS)], axis=0)]
        for module in ("sys", "numpy", "controller.play.__main__")
    )
    how = (
        f"median of {STARTS}, less {plain[0]:.0f} ms of Python's own; processor time {ours[1] - plain[1]:.0f} ms, "
        f"{numpy[1] - plain[1]:.0f} of it numpy"
    )
    return at_most("imports", ours[0] - plain[0], 150.0, unit="ms", how=how)


def starting(place: Path, settings: PlayerSettings) -> Row:
    """From the start of the process to an appearance of the bundle on the outputs."""
    times, used_s = [], []
    for _ in range(STARTS):
        began = time.perf_counter()
        with start_player(place, settings):
            display = DRIVER.open({}, OpenContext(stage=place, runtime=place), in_seconds(20))
            display.play("a0", deadline=in_seconds(20))
            times.append(time.perf_counter() - began)
            used_s.append(processor_s(int(display.identity(deadline=in_seconds(5)).serial)))
            display.close()
    how = (
        f"min {min(times):.2f}, max {max(times):.2f} over {STARTS}: process, bundle checked, first appearance shown; "
        f"processor time {1000 * min(used_s):.0f} ms at least"
    )
    return at_most("start to first picture", statistics.median(times), 0.7, unit="s", how=how)


def _sustained(display: PlayerDisplay, sets: int, *, paper: bool) -> list[Row]:
    """As fast as they go: every set decoded again, and then the same few from the cache."""
    rows = []
    for count, figure, goal in (
        (sets, "swaps sustained, each decoded", 120.0 if paper else None),
        (RESIDENT, "swaps sustained, decoded before", None),
    ):
        _play(display, AS_FAST_HZ, count)
        time.sleep(1.0)
        before, began = display.playing(deadline=in_seconds(5)), time.perf_counter()
        time.sleep(SUSTAINED_S)
        after, elapsed = display.playing(deadline=in_seconds(5)), time.perf_counter() - began
        assert after.interval_p50_s is not None
        assert after.interval_p99_s is not None
        how = (
            f"{count} appearances in turn for {elapsed:.0f} s; interval p50 {1000 * after.interval_p50_s:.2f} ms, "
            f"p99 {1000 * after.interval_p99_s:.2f} ms"
        )
        rate = (after.swaps - before.swaps) / elapsed
        rows.append(at_least(figure, rate, goal, unit="a second", how=how))
    return rows


def _paced(display: PlayerDisplay, rate_hz: float, sets: int, pid: int) -> list[Row]:
    goal = rate_hz == 30.0
    seconds = 60 * float(os.environ.get("BENCH_MINUTES", PACED_S / 60)) if goal else PACED_S
    _play(display, rate_hz, sets)
    used, before = processor_s(pid), display.playing(deadline=in_seconds(5)).swaps
    time.sleep(seconds)
    found = display.playing(deadline=in_seconds(5))
    assert found.interval_p50_s is not None
    assert found.interval_p99_s is not None
    tick_ms, swaps = 1000 / rate_hz, max(1, found.swaps - before)
    how = f"p50 {1000 * found.interval_p50_s:.2f} ms of {tick_ms:.2f}; {swaps} swaps in {seconds:g} s, each decoded"
    spent_ms = 1000 * (processor_s(pid) - used) / swaps
    return [
        at_most(f"interval at {rate_hz:g} Hz", 1000 * found.interval_p99_s, 34.5 if goal else None, unit="ms p99",
                how=how),
        at_most(f"late at {rate_hz:g} Hz", float(found.late), 0.0 if goal else None, unit="",
                how=f"by more than a tick; the goal is for 10 minutes; {spent_ms:.1f} ms of processor time a swap"),
    ]  # fmt: skip


def _fading(display: PlayerDisplay) -> Row:
    """Steps of one long cross-fade that are presented, of 60 a second; what is too slow is left out."""
    before = display.playing(deadline=in_seconds(5)).swaps
    items = [("a0", FADED_S, FADED_S)]
    began = time.perf_counter()
    display.play_sequence(items, repeat=1, rate_hz=FADED_HZ, deadline=in_seconds(FADED_S + 20))
    elapsed = time.perf_counter() - began
    steps = display.playing(deadline=in_seconds(5)).swaps - before
    how = f"{steps} steps of a cross-fade of {FADED_S:g} s, mixed in memory on 2 threads, of {FADED_HZ:g} a second"
    return at_least("steps of a fade", steps / elapsed, None, unit="a second", how=how)


def _watched(display: PlayerDisplay, place: Path, swaps: Sequence[dict[str, ByteImage]]) -> Row:
    """Another process reads sets while they change; what counts is how many it has read, not how many passed."""
    black = {name: np.zeros_like(frame) for name, frame in swaps[0].items()}
    known = [digest(frames) for frames in (*swaps, black)]
    _play(display, WATCHED_HZ, len(swaps))
    command = [sys.executable, "-m", "lab.timings.tools.watch", str(place / "outputs.frame"), str(FEWEST_WATCHED),
               f"{WATCHED_S:g}", *known]  # fmt: skip
    ended = subprocess.run(command, stdout=subprocess.PIPE, check=True, text=True)
    found = json.loads(ended.stdout.splitlines()[-1])
    how = f"{found['read']} sets read whole by another process while {found['passed']} passed"
    row = at_most("swaps that mix two appearances", float(found["mixed"]), 0.0, unit="", how=how)
    enough = found["read"] >= FEWEST_WATCHED or found["mixed"]
    return row if enough else replace(row, holds=None, how=f"{how}: too few to judge")


def _memory(player: PlayerProcess, display: PlayerDisplay, sets: int) -> list[Row]:
    """Private memory while every set is decoded again, and its growth in that time."""
    _play(display, AS_FAST_HZ, sets)
    time.sleep(2.0)
    first, begin = private_bytes(player.pid), display.playing(deadline=in_seconds(5)).swaps
    time.sleep(SUSTAINED_S)
    last, status = private_bytes(player.pid), display.playing(deadline=in_seconds(5))
    mapped, passed = status.rss_bytes - last, status.swaps - begin
    growth = at_most("memory, growth", (last - first) / 1e6, 0.0, unit="MB",
                     how=f"over {passed} swaps, each decoded; the goal is for {MANY_SWAPS}")  # fmt: skip
    return [
        at_most("memory beyond the mapped files", last / 1e6, 200.0, unit="MB",
                how=f"private and anonymous; {mapped / 1e6:.0f} MB of mapped files are resident beside it"),
        growth if passed >= MANY_SWAPS else replace(growth, holds=None),
    ]  # fmt: skip


def private_bytes(pid: int) -> int:
    """Memory of a process that is its own: not the mapped files."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("RssAnon:")).split()[1]) * 1024


def processor_s(pid: int) -> float:
    """Processor time that a process has used, all its threads."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _play(display: PlayerDisplay, rate_hz: float, sets: int) -> None:
    items = [(f"a{number}", 1 / rate_hz) for number in range(sets)]
    display.play_sequence(items, deadline=in_seconds(20), rate_hz=rate_hz)
