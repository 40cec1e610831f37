"""A run of several steps in a process of its own, for tests that kill it or press Ctrl-C.

Usage: toy_pipeline.py FOLDER [PAUSE_S]. Every piece of work leaves a line in FOLDER/worked.log before it begins.
"""

from __future__ import annotations

import hashlib
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from controller.core.storage import write_atomically
from controller.run.journal import Journal
from controller.run.runner import Context, Runner, Step
from controller.run.signals import cancelled_by_signals
from controller.run.state_machine import Event, Machine
from controller.run.step_id import ShotId, StepId
from controller.stage.rig.lamp_guard import LampGuard
from controller.stage.rig.lamp_ledger import LampFile
from controller.stage.rig.power import power_down
from hal.deadline import Cancelled, Deadline, in_seconds
from hal.values import DeviceIdentity, LampRules, Power, ProjectorCapabilities, ProjectorStatus

SHOTS = 12
PAUSE_S = float(sys.argv[2]) if len(sys.argv) > 2 else 0.01


class LampInAFile:
    """A projector whose lamp is a file, so that the test can see it when this process is gone."""

    def __init__(self, path: Path) -> None:
        self._path = path

    @property
    def capabilities(self) -> ProjectorCapabilities:
        return ProjectorCapabilities(False, False, (), False, LampRules(0.0, 0.0, 0.0, 0.0))

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        return DeviceIdentity("Toy", "Lamp")

    def close(self) -> None:
        """Nothing to release."""

    def status(self, *, deadline: Deadline) -> ProjectorStatus:
        lit = self._path.exists() and self._path.read_text() == "lit"
        return ProjectorStatus(Power.ON if lit else Power.OFF)

    def switch_on(self, *, deadline: Deadline) -> None:
        self._path.write_text("lit")

    def switch_off(self, *, deadline: Deadline) -> None:
        time.sleep(0.4)  # so that an impatient second Ctrl-C comes in the middle
        self._path.write_text("off")

    def set_shutter(self, closed: bool, *, deadline: Deadline) -> None:
        """It has none."""


def note(folder: Path, what: str) -> None:
    with (folder / "worked.log").open("a") as log:
        log.write(f"{what}\n")


def capture(context: Context) -> Sequence[Path]:
    paths = []
    for number in range(SHOTS):
        context.advance(number / SHOTS, f"shot {number}")
        shot, path = ShotId("shot", str(number)), context.folder / "captures" / f"{number}.raw"
        if context.journal.shot(shot, {"seed": "1"}) is None:
            note(context.folder, f"shot-{number}")
            time.sleep(PAUSE_S)
            write_atomically(path, hashlib.sha256(str(number).encode()).digest() * 1000)
            context.journal.record_shot(shot, {"seed": "1"}, path)
        paths.append(path)
    return paths


def digest(name: str, source: str) -> Step:
    def run(context: Context) -> Sequence[Path]:
        note(context.folder, name)
        for part in range(4):
            context.advance(part / 4)
            time.sleep(PAUSE_S)
        path = context.folder / f"{name}.bin"
        write_atomically(
            path, b"".join(hashlib.sha256(file.read_bytes()).digest() for file in context.paths(StepId(source)))
        )
        return [path]

    return Step(StepId(name), run, after=(StepId(source),))


def main(folder: Path) -> int:
    guard = LampGuard("toy", LampInAFile(folder / "lamp"), LampFile(folder / LampFile.NAME))

    def switch_on(context: Context) -> Sequence[Path]:
        guard.switch_on(deadline=context.deadline)
        return []

    steps = [
        Step(StepId("power"), switch_on, enter=Event.START, leave=Event.LAMPS_LIT, always=True),
        Step(StepId("capture"), capture),
        digest("decode", "capture"),
        digest("solve", "decode"),
    ]
    with cancelled_by_signals() as cancel, Journal(folder) as journal:
        print(f"begun {os.getpid()}", flush=True)
        machine = Machine(journal.record_change)
        try:
            Runner(steps, journal, machine=machine).run("toy", deadline=in_seconds(60, cancel))
        except Cancelled:
            return 130
        finally:
            machine.handle(Event.STOP)
            print("cooling", flush=True)
            failures = power_down([guard])
            machine.handle(Event.FAIL if failures else Event.COOLED)
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
