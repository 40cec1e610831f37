"""Many thousand swaps of a real player: whole sets, even pace, no growth.

    python -m tests.campaigns.playing 100000

Into memory as fast as they go, until so many have passed and so many were read back whole by this process, while the
player's private memory is measured; then on the windows of an X server without monitors, three outputs of 1400x1050,
30 times a second, three for ten of them and at most 10,800 (six minutes). Prints what was found; ends with 1 if a set
mixes two appearances or memory grows. Pace depends on the machine and what else it does, so it is only printed
(``lab.timings windows`` judges it). 100,000 take ten minutes on two free cores.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from controller.bundle.writer import NewAppearance, NewBundle, write_bundle
from controller.play.control.launch import PlayerSettings, start_player
from tests.controller.play.display.xorg import CONNECTORS, HEIGHT, WIDTH, running_server
from tests.controller.play.wire import Frames, Pictures, Wire, noise

NAMES: Final = ("P1", "P2", "P3")
APPEARANCES: Final = 80
"""More than a player keeps decoded, so that each is decoded again."""
FEW: Final = 6
RATE_HZ: Final = 30.0
MOST_IN_WINDOWS: Final = 10_800
_GROWTH_ALLOWED_BYTES: Final = 512 * 1024


@dataclass(frozen=True, slots=True)
class Found:
    """What was seen of one output medium; ``late`` and the intervals are the player's own."""

    passed: int
    read: int
    mixed: int
    growth_bytes: int
    late: int
    interval_p50_ms: float
    interval_p99_ms: float

    @property
    def holds(self) -> bool:
        return self.read > 0 and self.mixed == 0 and self.growth_bytes <= _GROWTH_ALLOWED_BYTES


def in_memory(swaps: int) -> Found:
    """Small pictures, each set decoded again, presented as fast as they go."""
    outputs = [(name, WIDTH, HEIGHT) for name in NAMES]
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        known = {whole(pictures) for pictures in _bundle(place, outputs, APPEARANCES)}
        settings = PlayerSettings(outputs, place / "f", bundle=place / "b.vel", allow_unsigned=True)
        with start_player(place, settings) as player, Wire(player.socket) as wire:
            frames = Frames(place / "f")
            return _watch(wire, player.pid, 1000.0, swaps, APPEARANCES,
                          lambda: whole(frames.read()) in known, fewest_read=swaps)  # fmt: skip


def in_windows(swaps: int, *, width: int, height: int, mode: str) -> Found:
    """Real windows at 30 Hz, their pixels read from the X server."""
    outputs = [(name, width, height) for name in NAMES]
    with tempfile.TemporaryDirectory() as folder, running_server(Path(folder)) as server:
        place = Path(folder)
        for number, connector in enumerate(CONNECTORS):
            server.place(connector, number * width, mode)
        known = {np.hstack(list(pictures.values())).tobytes() for pictures in _bundle(place, outputs, FEW)}
        where = dict(zip(NAMES, CONNECTORS, strict=True))
        settings = PlayerSettings(outputs, None, bundle=place / "b.vel", allow_unsigned=True, where=where)
        with start_player(place, settings) as player, Wire(player.socket) as wire:

            def is_complete() -> bool:
                # Reading costs what drawing costs, so not too often.
                time.sleep(0.2)
                return server.picture(0, len(NAMES) * width, height).tobytes() in known

            return _watch(wire, player.pid, RATE_HZ, swaps, FEW, is_complete)


def whole(pictures: Pictures) -> bytes:
    """A set as bytes."""
    return b"".join(picture.tobytes() for picture in pictures.values())


def _bundle(place: Path, outputs: list[tuple[str, int, int]], count: int) -> list[Pictures]:
    sets = [noise(outputs, seed) for seed in range(count)]
    made = [NewAppearance(str(number), pictures) for number, pictures in enumerate(sets)]
    write_bundle(
        place / "b.vel", NewBundle(stage="s", calibration="c", created_unix_s=0, outputs=outputs), appearances=made
    )
    return sets


def _watch(wire: Wire, pid: int, rate_hz: float, swaps: int, count: int, is_complete: Callable[[], bool],
           *, fewest_read: int = 1) -> Found:  # fmt: skip
    wire.ask("sequence", items=[[str(number), 1 / rate_hz] for number in range(count)], rate_hz=rate_hz)
    # Until every set that is kept has been decoded once, memory grows.
    first = wire.ask("status")["swaps"]
    while wire.ask("status")["swaps"] - first < 2 * count:
        time.sleep(0.2)
    begin, before = wire.ask("status")["swaps"], _private_bytes(pid)
    read = mixed = 0
    while (status := wire.ask("status"))["swaps"] - begin < swaps or read < fewest_read:
        for _ in range(10):
            read, mixed = read + 1, mixed + (not is_complete())
    return Found(
        passed=status["swaps"] - begin,
        read=read,
        mixed=mixed,
        growth_bytes=_private_bytes(pid) - before,
        late=status["late"],
        interval_p50_ms=1000 * status["interval_p50_s"],
        interval_p99_ms=1000 * status["interval_p99_s"],
    )


def _private_bytes(pid: int) -> int:
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("RssAnon:")).split()[1]) * 1024


def main() -> int:
    """Run both and print what was found."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    results = [
        in_memory(count),
        in_windows(min(MOST_IN_WINDOWS, max(30, round(0.3 * count))), width=1400, height=1050, mode="paper"),
    ]
    for name, found in zip(("memory", "windows"), results, strict=True):
        print(f"{name}: {found}, {'holds' if found.holds else 'DOES NOT HOLD'}")
    return 0 if all(found.holds for found in results) else 1


if __name__ == "__main__":
    sys.exit(main())
