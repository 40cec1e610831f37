"""Thousands of exchanges with projectors on lines that lose, bend, delay and cut, and are unplugged.

    python -m tests.campaigns.serial_noise 100000 [PACE]

Every call must end before its deadline: confirmed, or with a typed error. What is confirmed must be true: the emulated
lamp is asked behind the driver's back. Prints a table, one row a family; ends with 1 if a row does not hold.

PACE makes all patience and all delays so many times longer: on a loaded machine an answer may else come later than
``late_s`` allows, and be taken for the next one.
"""

from __future__ import annotations

import collections
import random
import sys
import tempfile
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

from hal.deadline import in_seconds
from hal.errors import DeviceError
from hal.interfaces import Projector
from hal.registry import OpenContext
from hal.values import Power
from lab.emulated.projectors.boards import BOARDS, baud_of
from lab.emulated.projectors.pjlink import EmulatedPjLinkProjector
from lab.emulated.scenario import ScenarioPlayer, parse_scenario
from plugins.emulated.projectors.lamp import EmulatedLamp, LampPhase, LampTiming, quick_profile
from plugins.emulated.projectors.serial import EmulatedSerialProjector
from plugins.projectors.pjlink import open_pjlink_projector
from plugins.projectors.serial import open_serial_projector

FAMILIES = (*(family for family in BOARDS if baud_of(family)), "pjlink")
DEADLINE_S = 0.6
GRACE_S = 0.3
"""How late a call may end on a loaded machine: waiting is done in slices of 0.05 s."""
HOURS = 1234
TIMING = LampTiming(warm_up_s=0.02, cool_down_s=0.02)
QUICK = {
    "answer_s": 0.06,
    "late_s": 0.12,
    "command_s": 0.08,
    "confirm_s": 0.4,
    "interval_s": 0.0,
    "boot_interval_s": 0.002,
}
FAULTS = """
[[event]]
do = "silence"
probability = 0.02
[[event]]
do = "garbage"
probability = 0.02
[[event]]
do = "cut"
probability = 0.02
[[event]]
do = "slow"
delay_s = {short}
probability = 0.02
[[event]]
do = "slow"
delay_s = {long}
probability = 0.02
[[event]]
do = "busy"
for_s = 0.05
probability = 0.005
[[event]]
do = "unplug"
for_s = 0.05
probability = 0.004
"""


@dataclass
class Outcome:
    """What came of one family's exchanges."""

    family: str
    calls: int = 0
    confirmed: int = 0
    faults: int = 0
    late_s: float = 0.0
    errors: collections.Counter[str] = field(default_factory=collections.Counter)
    wrong: list[str] = field(default_factory=list)

    @property
    def all_ended(self) -> bool:
        """Whether every call was confirmed or ended with a typed error, and nothing that was confirmed was wrong."""
        return not self.wrong and self.confirmed + self.errors.total() == self.calls

    @property
    def holds(self) -> bool:
        return self.all_ended and self.late_s <= GRACE_S


def campaign(family: str, calls: int, seed: int, folder: Path, pace: float = 1.0) -> Outcome:
    """``calls`` calls of a driver of ``family`` over a line that misbehaves; the same seed does the same.

    ``pace``: all patience and all delays are so many times longer, for a machine under load.
    """
    lamp = EmulatedLamp(TIMING, hours=HOURS)
    text = quick_profile(TIMING, base=family)
    for key, seconds in QUICK.items():
        lines = [f"{key} = {seconds * pace}" if line.startswith(f"{key} =") else line for line in text.splitlines()]
        text = "\n".join(lines)
    (folder / "quick.toml").write_text(text)
    faults = FAULTS.format(short=0.03 * pace, long=0.09 * pace)
    scenario = parse_scenario(f"seed = {seed}\n{faults}", file="campaign")
    if family == "pjlink":
        with EmulatedPjLinkProjector(lamp) as server:
            table = {"address": server.address, "profile": "quick.toml"}
            driver: Projector = open_pjlink_projector(table, OpenContext(folder), in_seconds(5))
            server.scenario = ScenarioPlayer(scenario, device=family, faults=server.faults, lamp=lamp)
            return _exchanged(driver, lamp, server.scenario, Outcome(family), calls, seed, pace)
    baud = int(next(line for line in text.splitlines() if line.startswith("baud")).partition("=")[2].split("#")[0])
    with EmulatedSerialProjector(folder / "tty", lamp, board=BOARDS[family](lamp), baud=baud) as wire:
        table = {"profile": "quick.toml", "port": "tty"}
        driver = open_serial_projector(table, OpenContext(folder), in_seconds(5))
        wire.scenario = ScenarioPlayer(scenario, device=family, faults=wire.faults, lamp=lamp, plug=wire)
        return _exchanged(driver, lamp, wire.scenario, Outcome(family), calls, seed, pace)


def _exchanged(
    driver: Projector, lamp: EmulatedLamp, player: ScenarioPlayer, outcome: Outcome, calls: int, seed: int, pace: float
) -> Outcome:
    dice = random.Random(seed)
    for _ in range(calls):
        word = dice.choices(["status", "on", "off", "shutter"], [20, 1, 1, 1])[0]
        strikes, started = lamp.strikes, time.monotonic()
        deadline = in_seconds(DEADLINE_S * pace)
        outcome.calls += 1
        try:
            if word == "status":
                status = driver.status(deadline=deadline)
                if status.lamp_hours not in (None, HOURS):
                    outcome.wrong.append(f"{status.lamp_hours} lamp hours")
                burns = lamp.phase in (LampPhase.WARMING, LampPhase.LIT)
                if status.power in (Power.ON, Power.OFF) and burns is not (status.power is Power.ON):
                    outcome.wrong.append(f"told {status.power.value} of a lamp that is {lamp.phase.value}")
            elif word == "shutter":
                driver.set_shutter(dice.random() < 0.5, deadline=deadline)
            elif word == "on":
                driver.switch_on(deadline=deadline)
            else:
                driver.switch_off(deadline=deadline)
            outcome.confirmed += 1
        except DeviceError as error:
            outcome.errors[type(error).__name__] += 1
        outcome.late_s = max(outcome.late_s, time.monotonic() - started - DEADLINE_S * pace)
        if lamp.strikes - strikes > 1:
            outcome.wrong.append("struck twice by one call")
    outcome.faults = len(player.happened)
    driver.close()
    return outcome


def run(calls: int, seed: int = 1, pace: float = 1.0) -> list[Outcome]:
    """``calls`` calls shared among all families, which run side by side."""
    outcomes: list[Outcome] = []

    def one(family: str, folder: Path) -> None:
        outcomes.append(campaign(family, calls // len(FAMILIES), seed, folder, pace))

    with tempfile.TemporaryDirectory() as place:
        threads = []
        for family in FAMILIES:
            folder = Path(place) / family
            folder.mkdir()
            threads.append(threading.Thread(target=one, args=(family, folder)))
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    return sorted(outcomes, key=lambda outcome: outcome.family)


def main() -> int:
    calls = int(sys.argv[1]) if len(sys.argv) > 1 else 2000
    started = time.monotonic()
    outcomes = run(calls, pace=float(sys.argv[2]) if len(sys.argv) > 2 else 1.0)
    print(f"{'family':<14} {'calls':>7} {'faults':>7} {'confirmed':>9} {'late s':>7}  errors")
    for outcome in outcomes:
        errors = ", ".join(f"{name} {count}" for name, count in sorted(outcome.errors.items()))
        row = f"{outcome.family:<14} {outcome.calls:>7} {outcome.faults:>7} {outcome.confirmed:>9}"
        print(f"{row} {max(0.0, outcome.late_s):>7.2f}  {errors}")
        for wrong, count in collections.Counter(outcome.wrong).items():
            print(f"{'':<14} WRONG: {wrong} ({count} times)")
    holds = len(outcomes) == len(FAMILIES) and all(outcome.holds for outcome in outcomes)
    print(f"{'holds' if holds else 'DOES NOT HOLD'}, {time.monotonic() - started:.0f} s")
    return 0 if holds else 1


if __name__ == "__main__":
    sys.exit(main())
