"""Players of three computers in step, on a network that delays, loses and is cut; as root.

    python -m tests.campaigns.in_step [COUNT] [no-loss] [loss] [troubles] [bundle]

Swaps are compared by what each player itself says that it presented, and when. Then things go wrong: computers and
programs end, the network is cut for a minute, a clock is set, and a bundle of 1 GB comes to three hosts over links of
which two are cut. Words choose parts; without one, all are made. Prints what was found; ends with 1 if a swap is mixed
or a computer is not back in time. The skew depends on what else the machine does, so it is only printed. 100,000 swaps
take 17 minutes, twice.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from controller.bundle.writer import NewAppearance, NewBundle, write_bundle
from tests.campaigns.network import Network, network
from tests.controller.play.conftest import write_noise
from tests.controller.play.wire import Wire
from tests.controller.stage.hosts.computers import Computers, running

NAMES: Final = ("left", "right", "back")
PARTS: Final = ("no-loss", "loss", "troubles", "bundle")
RATE_HZ: Final = 100
BACK_S: Final = 5.0


class Spread(Computers):
    """Each computer in a namespace of its own; "here" is the conductor's."""

    def __init__(self, folder: Path, net: Network) -> None:
        names = NAMES[: len(net.names) - 1]
        super().__init__(folder, names, None, ["--rate", str(RATE_HZ)])
        self.net = net
        self.places = dict(zip(["here", *names], net.names, strict=True))
        self.address = net.address("a")

    def prefix(self, name: str) -> list[str]:
        # A kiosk's player has its computer for itself; this machine does other things, too.
        return ["chrt", "--fifo", "20", *self.net.prefix(self.places[name])]


@contextmanager
def spread(count: int) -> Iterator[Spread]:
    """That all play."""
    with network(count) as net, tempfile.TemporaryDirectory(prefix="velatura-") as folder:
        computers = Spread(Path(folder), net)
        computers.bundle = write_noise(Path(folder) / "b.vel", outputs=computers.outputs)
        with running(computers):
            yield computers


@dataclass(frozen=True, slots=True)
class Swaps:
    """Of ``compared`` moments: how many were ``mixed``, and seconds between the first and the last player."""

    compared: int
    mixed: int
    lonely: int
    p50_s: float
    p99_s: float
    most_s: float
    late: int

    def __str__(self) -> str:
        return (
            f"{self.compared} swaps compared, {self.mixed} mixed, {self.lonely} left out, {self.late} late; "
            f"skew p50 {1e3 * self.p50_s:.2f} ms, p99 {1e3 * self.p99_s:.2f} ms, most {1e3 * self.most_s:.1f} ms"
        )


class Watch:
    """What each player says that it presented, by the moment that was due."""

    def __init__(self, computers: Computers) -> None:
        self._computers = computers
        self._after = dict.fromkeys(computers.players(), 0)
        self.seen: dict[str, dict[int, tuple[float, str]]] = {name: {} for name in self._after}
        self.look()
        for dues in self.seen.values():
            dues.clear()

    def look(self) -> None:
        for name, path in self._computers.players().items():
            with Wire(path) as wire:
                while rows := wire.ask("reports", after=self._after[name])["reports"]:
                    self._after[name] = rows[-1][0]
                    self.seen[name] |= {round(1e4 * due): (at, what) for _, due, at, what in rows}

    def swaps(self) -> Swaps:
        dues = [set(seen) for seen in self.seen.values()]
        # The first and the last second: one player may have been asked before another one.
        first, last = max(min(one) for one in dues) + 10_000, min(max(one) for one in dues) - 10_000
        every, common = (
            {due for due in some if first <= due <= last} for some in (set.union(*dues), set.intersection(*dues))
        )
        pairs = [[seen[due] for seen in self.seen.values()] for due in common]
        apart = np.array([max(at for at, _ in pair) - min(at for at, _ in pair) for pair in pairs])
        late = 0
        for path in self._computers.players().values():
            with Wire(path) as wire:
                late += int(wire.ask("status")["late"])
        mixed = sum(len({what for _, what in pair}) > 1 for pair in pairs)
        p50, p99 = np.percentile(apart, [50, 99])
        return Swaps(len(common), mixed, len(every - common), float(p50), float(p99), float(apart.max()), late)


def begin(computers: Computers, seconds: float) -> None:
    """All three play, an appearance for so many seconds each."""
    items = [[str(number), seconds] for number in range(6)]
    play(computers, {"items": items})


def play(computers: Computers, request: dict[str, Any], within_s: float = 30.0) -> float:
    """Seconds until the sequence was accepted: a bundle on its way is refused until it is there."""
    began_s = time.monotonic()
    with computers.wire() as wire:
        while not (answer := wire.ask("sequence", **request))["ok"]:
            assert answer["error"]["code"] in ("hosts-behind", "superseded"), answer
            assert time.monotonic() - began_s < within_s, answer
            time.sleep(0.2)
    return time.monotonic() - began_s


def compared(computers: Computers, count: int, seconds: float = 1 / RATE_HZ) -> Swaps:
    """``count`` swaps of a sequence."""
    begin(computers, seconds)
    watch, until_s = Watch(computers), time.monotonic() + count * seconds + 2.5
    while time.monotonic() < until_s:
        time.sleep(min(2.0, max(0.1, until_s - time.monotonic())))
        watch.look()
    return watch.swaps()


def seconds_until(true: Callable[[], bool], within_s: float = 30.0) -> float:
    began_s = time.monotonic()
    while not true():
        assert time.monotonic() - began_s < within_s, "it did not happen in time"
        time.sleep(0.05)
    return time.monotonic() - began_s


def shown(computers: Computers, name: str) -> dict[str, Any]:
    """The status of one player; what is wrong while it does not run."""
    try:
        with Wire(computers.players()[name]) as wire:
            return wire.ask("status")
    except OSError:
        return {"sequence_running": False, "appearance": None, "showing": "", "alone": False, "reported": 0}


def goes_on(computers: Computers, name: str, seconds: float = 1.0) -> bool:
    before = shown(computers, name)["reported"]
    time.sleep(seconds)
    return bool(shown(computers, name)["reported"] > before)


def troubles(computers: Spread, cut_s: float) -> dict[str, float]:
    """Things go wrong while all play; seconds until each was well again."""
    begin(computers, 0.1)
    back: dict[str, float] = {}

    def well() -> bool:
        status = computers.status()
        there = not status["lost_hosts"] and not status["missing_outputs"]
        return there and all(shown(computers, name)["sequence_running"] for name in computers.players())

    computers.kill("left")
    assert goes_on(computers, "left"), "a player ended with its agent"
    seconds_until(lambda: computers.status()["lost_hosts"] == ["left"])
    computers.follow("left")
    back["an agent was killed"] = seconds_until(well)

    with Wire(computers.players()["right"]) as wire:
        wire.ask("quit")
    seconds_until(lambda: not shown(computers, "right")["sequence_running"])
    back["a player ended"] = seconds_until(well)

    computers.kill("here")
    assert all(goes_on(computers, name) for name in computers.players()), "a player stopped with the conductor"
    computers.conduct()
    seconds_until(computers.socket.exists)
    back["the conductor was killed"] = seconds_until(lambda: _tried(well))

    computers.net.cut = {computers.places["left"]}
    seconds_until(lambda: computers.status()["lost_hosts"] == ["left"])
    time.sleep(cut_s)
    assert all(goes_on(computers, name) for name in computers.players()), "a player stopped without the network"
    computers.net.cut = set()
    back[f"the network was cut for {cut_s:g} s"] = seconds_until(well)

    (computers.place("right") / "clock").write_text("5")
    seconds_until(lambda: "set by +5" in computers.status()["clock_troubles"]["right"])
    watch = Watch(computers)
    time.sleep(4)
    watch.look()
    found = watch.swaps()
    assert found.compared > 10, "a clock that was set moved the pictures"
    assert found.mixed == 0
    (computers.place("right") / "clock").write_text("0")
    back["a clock was set by 5 s"] = seconds_until(
        lambda: "set by" not in computers.status()["clock_troubles"]["right"]
    )
    return back


def _tried(true: Callable[[], bool]) -> bool:
    try:
        return true()
    except OSError:
        return False


def large_bundle(computers: Spread, size: int) -> float:
    """Seconds in which a bundle of about ``size`` bytes comes to all, over a link that is cut twice; all play it then.

    Until it is there, none plays it.
    """
    random = np.random.default_rng(3)
    outputs = [*computers.outputs, ("other", 2048, 2048)]
    count = max(2, size // (3 * 2048 * 2048))
    path = computers.folder / "large.vel"

    def picture(number: int) -> NewAppearance:
        pictures = {name: random.integers(0, 256, (height, width, 3), np.uint8) for name, width, height in outputs}
        return NewAppearance(f"new {number}", pictures)

    write_bundle(path, NewBundle("s", "c", created_unix_s=0, outputs=outputs), map(picture, range(count)))
    with computers.wire() as wire:
        before = shown(computers, "left")["bundle"]
        answer = wire.ask("load-bundle", path=str(path))
        assert answer["ok"], answer
        refused = wire.ask("play", appearance="new 1")
        assert refused["error"]["code"] == "hosts-behind"
    began_s = time.monotonic()
    for name in computers.names[:2]:
        time.sleep(min(2.0, size / 4e8))
        computers.net.cut = {computers.places[name]}
        time.sleep(4.0)
        assert {shown(computers, one)["bundle"] for one in computers.players()} == {before}
        computers.net.cut = set()
    play(computers, {"items": [["new 0", 0.5], ["new 1", 0.5]]}, 600)
    took_s = time.monotonic() - began_s
    seconds_until(lambda: {shown(computers, one)["bundle"] for one in computers.players()} == {answer["bundle"]})
    return took_s


def main(count: int, parts: Sequence[str]) -> int:
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(20))  # It carries the packets.
    holds = True
    with spread(3) as computers:
        net = computers.net
        for part, text, delay_s, jitter_s, loss in (
            ("no-loss", "no loss", 0, 0, 0), ("loss", "20 ms +- 10 ms, 2 % loss", 0.02, 0.01, 0.02),
        ):  # fmt: skip
            if part in parts:
                net.delay_s, net.jitter_s, net.loss = delay_s, jitter_s, loss
                found = compared(computers, count)
                print(f"{text}: {found}", flush=True)
                holds = holds and not found.mixed
        net.delay_s = net.jitter_s = net.loss = 0.0
        if "troubles" in parts:
            for text, took_s in troubles(computers, 60.0).items():
                print(f"{text}: well again after {took_s:.1f} s", flush=True)
                holds = holds and took_s <= BACK_S
    if "bundle" in parts:
        with spread(4) as computers:
            took_s = large_bundle(computers, 1_000_000_000)
        print(f"1 GB to {len(computers.names)} hosts, two links cut: everywhere after {took_s:.0f} s", flush=True)
    return 0 if holds else 1


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("count", type=int, nargs="?", default=100_000)
    parser.add_argument("parts", choices=PARTS, nargs="*", default=PARTS)
    options = parser.parse_args()
    sys.exit(main(options.count, options.parts))
