"""Thousands of captures on cameras that are busy, slow, lose events, leave and come back, and lie about lengths.

    python -m tests.campaigns.camera_faults [CAPTURES] [SEED]

Half of the cameras are on PTP/IP, half on the emulated USB bus. Prints one line for each camera, and ends with 0 where
no picture was lost or taken twice, none was another one than the newest, every call ended in time, and the driver
reported every fault that it had to repair.
"""

from __future__ import annotations

import collections
import json
import os
import random
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final, Protocol

from hal.deadline import in_seconds
from hal.errors import DeviceError
from hal.values import ExposureSettings
from lab.emulated.cameras.camera import EmulatedPtpCamera
from lab.emulated.usb.bus import environment
from lab.emulated.usb.camera import numbered_files
from lab.emulated.usb.process import UsbBusProcess
from plugins.emulated.core.shot import ShotFiles, ShotSettings
from plugins.ptp.ip import PtpIpAddress, PtpIpLink
from plugins.ptp.link import PtpLink
from plugins.ptp.shot import Timing
from plugins.ptp.still import PtpCamera

FLAVOURS: Final = ("generic", "eos-new", "eos-old")
CAMERAS: Final = tuple(f"{bus} {flavour}" for bus in ("network", "usb") for flavour in FLAVOURS)
SIZE: Final = 40_000
SLOW_S: Final = 0.06
DEADLINE_S: Final = 40.0
MOST_ON_A_BUS: Final = 80
"""Captures of one process on the emulated bus: the preload library keeps some sockets of nodes that went."""
HANG_S: Final = 5.0
"""A call may end that much after its deadline on a busy machine."""
TIMING: Final = Timing(
    answer_s=10.0, busy_s=10.0, margin_s=3.0, grace_s=0.1, come_back_s=10.0, reconnect_s=20.0, slow_s=SLOW_S / 2
)
_MENDED: Final = {
    "busy": {"camera-busy"},
    "slow_s": {"camera-slow"},
    "lost_events": {"camera-event-lost"},
    "drop_after_exposure": {"camera-disconnected"},
    "drop_in_transfer": {"camera-disconnected", "camera-protocol"},
    "drop_before_exposure": {"camera-shot-lost", "camera-disconnected"},
    "wrong_lengths": {"camera-protocol"},
}
"""Each fault, and the codes under which the driver may report it."""


class Bench(Protocol):
    """The emulated camera of one campaign."""

    def connect(self) -> Callable[[Any], PtpLink]: ...

    def fault(self, name: str, value: float) -> None: ...

    def left(self, name: str) -> float:
        """What has not been used up of a fault."""

    def exposures(self) -> int: ...


@dataclass
class Outcome:
    """What came of one camera's captures."""

    camera: str
    captures: int = 0
    pictures: int = 0
    faults: int = 0
    told: int = 0
    late_s: float = 0.0
    errors: dict[str, int] = field(default_factory=dict)
    wrong: list[str] = field(default_factory=list)

    def add(self, more: Outcome) -> None:
        self.captures += more.captures
        self.pictures += more.pictures
        self.faults += more.faults
        self.told += more.told
        self.late_s = max(self.late_s, more.late_s)
        self.errors = dict(collections.Counter(self.errors) + collections.Counter(more.errors))
        self.wrong += more.wrong

    @property
    def holds(self) -> bool:
        return not self.wrong and self.late_s <= HANG_S


class NetworkBench:
    def __init__(self, flavour: str) -> None:
        self.camera = EmulatedPtpCamera(self._expose, flavour=flavour, time_scale=0.0)  # type: ignore[arg-type]

    def _expose(self, shot: ShotSettings) -> ShotFiles:
        return numbered_files(self.camera.body.exposures, SIZE, shot)

    def connect(self) -> Callable[[Any], PtpLink]:
        address = PtpIpAddress.parse(self.camera.address)
        return lambda until: PtpIpLink.connect(address, deadline=until)

    def fault(self, name: str, value: float) -> None:
        setattr(self.camera.faults, name, value)

    def left(self, name: str) -> float:
        return float(getattr(self.camera.faults, name))

    def exposures(self) -> int:
        return self.camera.body.exposures


class UsbBench:
    def __init__(self, bus: UsbBusProcess, flavour: str) -> None:
        self._bus = bus
        bus.add("camera", "camera", flavour=flavour, size=SIZE, time_scale=0.0)
        bus.set("camera", "pipe_faults.away_s", 0.02)

    def connect(self) -> Callable[[Any], PtpLink]:
        from plugins.ptp.usb.bus import UsbAddress, UsbFinder

        return UsbFinder(UsbAddress()).connect

    def fault(self, name: str, value: float) -> None:
        self._bus.set("camera", f"camera_faults.{name}", value)

    def left(self, name: str) -> float:
        return float(self._bus.get("camera", f"camera_faults.{name}"))

    def exposures(self) -> int:
        return int(self._bus.get("camera", "body.exposures"))


@contextmanager
def _bench(camera: str) -> Iterator[Bench]:
    bus, flavour = camera.split()
    with ExitStack() as stack:
        if bus == "usb":
            process = stack.enter_context(UsbBusProcess(Path(os.environ["UMOCKDEV_DIR"])))
            yield UsbBench(process, flavour)
        else:
            made = NetworkBench(flavour)
            stack.enter_context(made.camera)
            yield made


def campaign(camera: str, captures: int, seed: int, folder: Path) -> Outcome:
    """So many captures of one camera, about half of them with a fault."""
    outcome = Outcome(camera)
    dice = random.Random(f"{seed} {camera}")
    with _bench(camera) as bench:
        driver = PtpCamera(bench.connect(), timing=TIMING, deadline=in_seconds(20))
        try:
            driver.configure(ExposureSettings(1 / 60, 100, raw=False), deadline=in_seconds(20))
            driver.notices()
            for _ in range(captures):
                _capture(driver, bench, dice, outcome, folder)
        finally:
            driver.close()
    return outcome


def _capture(driver: PtpCamera, bench: Bench, dice: random.Random, outcome: Outcome, folder: Path) -> None:
    """One capture: the newest picture, or an error and nothing that was exposed and lost in silence."""
    fault = dice.choice((*_MENDED, *[""] * len(_MENDED)))
    if fault:
        bench.fault(fault, SLOW_S if fault == "slow_s" else dice.choice((1, 1, 2)) if fault == "busy" else 1)
    before, started = bench.exposures(), time.monotonic()
    codes: list[str] = []
    outcome.captures += 1
    try:
        files = driver.capture(folder / "shot", deadline=in_seconds(DEADLINE_S))
    except DeviceError as error:
        codes.append(error.code)
        outcome.errors[error.code] = outcome.errors.get(error.code, 0) + 1
        fired = bench.exposures() - before
        if fired:
            outcome.wrong.append(f"a picture was lost: {error.code} after {fault or 'no fault'}")
    else:
        fired = bench.exposures() - before
        outcome.pictures += 1
        right = numbered_files(before + 1, SIZE, ShotSettings(1, 1, 1, raw=False, jpeg=True)).jpeg
        if fired != 1:
            outcome.wrong.append(f"exposed {fired} times after {fault or 'no fault'}")
        if [file.path.read_bytes() for file in files] != [right]:
            outcome.wrong.append(f"another picture than the newest after {fault or 'no fault'}")
    outcome.late_s = max(outcome.late_s, time.monotonic() - started - DEADLINE_S)
    codes += [notice.code for notice in driver.notices()]
    if fault:
        used = fault == "slow_s" or bench.left(fault) == 0
        told = bool(_MENDED[fault] & set(codes))
        outcome.faults += used
        outcome.told += used and told
        if used and not told:
            outcome.wrong.append(f"{fault} was not told: {sorted(set(codes))}")
        bench.fault(fault, 0)


def _in_a_process(camera: str, count: int, seed: int) -> Outcome:
    with tempfile.TemporaryDirectory(prefix="usb", dir="/tmp") as bus:
        done = subprocess.run(
            [sys.executable, "-m", "tests.campaigns.camera_faults", "one", camera, str(count), str(seed)],
            env={**os.environ, **environment(Path(bus))},
            cwd=Path(__file__).parents[2],
            stdout=subprocess.PIPE,
            check=False,
        )
    ended = f"its process ended with {done.returncode}"
    return Outcome(**json.loads(done.stdout)) if not done.returncode else Outcome(camera, wrong=[ended])


def run(captures: int, seed: int = 1) -> list[Outcome]:
    """``captures`` shared among all cameras; those on USB each in a process that sees its own emulated bus."""
    outcomes: list[Outcome] = []

    def network(camera: str) -> None:
        with tempfile.TemporaryDirectory() as folder:
            outcomes.append(campaign(camera, captures // len(CAMERAS), seed, Path(folder)))

    def usb(camera: str) -> None:
        whole = Outcome(camera)
        left = captures // len(CAMERAS)
        while left > 0:
            count = min(left, MOST_ON_A_BUS)
            whole.add(_in_a_process(camera, count, seed + left))
            left -= count
        outcomes.append(whole)

    threads = [
        threading.Thread(target=network if camera.startswith("network") else usb, args=(camera,)) for camera in CAMERAS
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return sorted(outcomes, key=lambda outcome: outcome.camera)


def main() -> int:
    if sys.argv[1:2] == ["one"]:
        with tempfile.TemporaryDirectory() as folder:
            outcome = campaign(sys.argv[2], int(sys.argv[3]), int(sys.argv[4]), Path(folder))
        print(json.dumps(asdict(outcome)))
        return 0
    captures = int(sys.argv[1]) if len(sys.argv) > 1 else 10_000
    started = time.monotonic()
    outcomes = run(captures, int(sys.argv[2]) if len(sys.argv) > 2 else 1)
    print(f"{'camera':<16} {'captures':>8} {'pictures':>8} {'faults':>7} {'told':>7} {'late s':>7}  errors")
    for outcome in outcomes:
        errors = ", ".join(f"{name} {count}" for name, count in sorted(outcome.errors.items()))
        numbers = f"{outcome.captures:>8} {outcome.pictures:>8} {outcome.faults:>7} {outcome.told:>7}"
        print(f"{outcome.camera:<16} {numbers} {max(0.0, outcome.late_s):>7.2f}  {errors}")
        for wrong, count in collections.Counter(outcome.wrong).items():
            print(f"{'':<16} WRONG: {wrong} ({count} times)")
    holds = len(outcomes) == len(CAMERAS) and all(outcome.holds for outcome in outcomes)
    print(f"{'holds' if holds else 'DOES NOT HOLD'}, {time.monotonic() - started:.0f} s")
    return 0 if holds else 1


if __name__ == "__main__":
    sys.exit(main())
