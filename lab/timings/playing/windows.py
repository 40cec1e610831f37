"""Real windows without a graphics card: one window over three outputs of Xorg's dummy driver, drawn by llvmpipe.

``BENCH_MINUTES`` in the environment says for how long 30 Hz is played (10 for the goal; else half a minute). Needs
Xorg, its dummy driver and xrandr (.ci/system-packages).
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from controller.bundle.writer import NewAppearance, NewBundle, write_bundle
from controller.core.arrays import ByteImage
from controller.play.control.launch import PlayerProcess, PlayerSettings, start_player
from lab.timings import Row, at_least, at_most
from lab.timings.playing.player import keep_compiled, more_than_kept, private_bytes, processor_s, starting
from lab.timings.tools.frames import OUTPUTS, compensation_frames
from tests.controller.play.display.xorg import CONNECTORS, MODES, running_server
from tests.controller.play.wire import Wire

MINUTES = 0.5
GOAL_MINUTES = 10.0
OTHER_RATES_S = 20.0
GOAL_P50_OFF_MS = 0.1
GOAL_P99_MS = 34.5
SIZES_PX = {"small": ("small", 160, 120), "medium": ("paper", 1400, 1050), "paper": ("paper", 1400, 1050)}


@dataclass(frozen=True, slots=True)
class Played:
    """Some time of one sequence: the player's own figures, and what it used."""

    seconds: float
    swaps: int
    late: int
    p50_ms: float
    p99_ms: float
    longest_ms: float
    core_share: float
    grown_bytes: int


def measure(size: str) -> list[Row]:
    """Pace at 30 Hz, then 60 Hz and as fast as it goes, and beside each the same on memory outputs: the loop alone."""
    keep_compiled()
    mode, width, height = SIZES_PX[size]
    minutes = float(os.environ.get("BENCH_MINUTES", MINUTES))
    with tempfile.TemporaryDirectory(prefix="velatura-bench-") as folder, running_server(Path(folder)) as server:
        place = Path(folder)
        for number, connector in enumerate(CONNECTORS):
            server.place(connector, number * width, mode)
        sets = _tiled("small" if size == "small" else "medium", width, height)
        bundle = _bundle(place, sets, width, height)
        outputs = [(name, width, height) for name in OUTPUTS]
        several: dict[str, Any] = {"bundle": bundle, "allow_unsigned": True}
        where = dict(zip(OUTPUTS, CONNECTORS, strict=True))
        windows = PlayerSettings(outputs, None, where=where, **several)
        start = starting(place, windows)
        with start_player(place, windows) as player:
            paced = _play(player, 30.0, len(sets), 60 * minutes)
            rows = [start, *_at_30(paced, minutes, judged=size == "paper" and minutes >= GOAL_MINUTES)]
            seconds = min(OTHER_RATES_S, 60 * minutes)
            rows += _other_rates(player, len(sets), "windows", mode, seconds)
        with start_player(place, PlayerSettings(outputs, place / "outputs.frame", **several)) as player:
            rows += _other_rates(player, len(sets), "memory: the loop and the decoding alone", mode, seconds)
    return rows


def _tiled(solved: str, width: int, height: int) -> list[dict[str, ByteImage]]:
    """Sets of solved and dithered frames, laid side by side to the outputs' size, moved a little from set to set."""
    (frames,) = compensation_frames(solved, 1)
    whole = {}
    for name, frame in frames.items():
        repeats = (-(-height // frame.shape[0]), -(-width // frame.shape[1]), 1)
        whole[name] = np.tile(frame, repeats)[:height, :width]
    count = more_than_kept(sum(frame.nbytes for frame in whole.values()))
    return [{name: np.roll(frame, 3 * number, axis=1) for name, frame in whole.items()} for number in range(count)]


def _bundle(place: Path, sets: Sequence[dict[str, ByteImage]], width: int, height: int) -> Path:
    path = place / "bundle.vel"
    write_bundle(
        path,
        NewBundle(
            stage="timing",
            calibration="timing",
            created_unix_s=0,
            outputs=[(name, width, height) for name in OUTPUTS],
        ),
        appearances=(NewAppearance(f"a{n}", frames) for n, frames in enumerate(sets)),
    )
    return path


def _play(player: PlayerProcess, rate_hz: float, sets: int, seconds: float) -> Played:
    with Wire(player.socket) as wire:
        items = [[f"a{number}", 1 / rate_hz] for number in range(sets)]
        # Until every set has been decoded and every texture drawn once; then count from 0.
        wire.ask("sequence", items=items, rate_hz=rate_hz)
        time.sleep(min(3.0, seconds))
        wire.ask("sequence", items=items, rate_hz=rate_hz)
        memory, used, began = private_bytes(player.pid), processor_s(player.pid), time.perf_counter()
        before = wire.ask("status")
        time.sleep(seconds)
        after, elapsed = wire.ask("status"), time.perf_counter() - began
        return Played(
            seconds=elapsed,
            swaps=after["swaps"] - before["swaps"],
            late=after["late"],
            p50_ms=1000 * after["interval_p50_s"],
            p99_ms=1000 * after["interval_p99_s"],
            longest_ms=1000 * after["interval_longest_s"],
            core_share=(processor_s(player.pid) - used) / elapsed,
            grown_bytes=private_bytes(player.pid) - memory,
        )


def _at_30(found: Played, minutes: float, *, judged: bool) -> list[Row]:
    over = f"over {minutes:g} minutes, {found.swaps} swaps, each decoded; the goal is for {GOAL_MINUTES:g} minutes"
    dropped = max(0, round(30.0 * found.seconds) - found.swaps - 1)
    off_ms = abs(found.p50_ms - 1000 / 30)
    return [
        at_most("30 Hz, p50 off its 33.33 ms", off_ms, GOAL_P50_OFF_MS if judged else None, unit="ms",
                how=f"p50 {found.p50_ms:.2f}, longest {found.longest_ms:.1f} ms"),
        at_most("30 Hz, p99", found.p99_ms, GOAL_P99_MS if judged else None, unit="ms",
                how=over),
        at_most("30 Hz, swaps dropped", float(dropped), 0.0 if judged else None, unit="",
                how=f"ticks without a new set; {found.late} were late by more than a tick"),
        at_most("30 Hz, one core's share", 100 * found.core_share, None, unit="%", how="decoding, uploading, drawing"),
        at_most("30 Hz, memory growth", found.grown_bytes / 1e6, 0.0 if judged else None, unit="MB", how="private"),
    ]  # fmt: skip


def _other_rates(player: PlayerProcess, sets: int, medium: str, mode: str, seconds: float) -> list[Row]:
    """60 Hz as asked for, and as fast as the medium lets it."""
    rows = []
    for rate_hz, name in ((60.0, "60 Hz"), (1000.0, "as fast as it goes")):
        found = _play(player, rate_hz, sets, seconds)
        each_ms = 1000 * found.core_share * found.seconds / max(found.swaps, 1)
        how = (f"p50 {found.p50_ms:.2f}, p99 {found.p99_ms:.2f}, longest {found.longest_ms:.1f} ms, {found.late} late, "
               f"{each_ms:.1f} ms of processor time a swap; outputs of {MODES[mode][1]}x{MODES[mode][5]}")  # fmt: skip
        rows.append(at_least(f"{medium}, {name}", found.swaps / found.seconds, None, unit="swaps a second", how=how))
    return rows
