"""Every fault of every emulated device at every step of a kiosk, through real drivers on real wires, in real time.

    python -m tests.campaigns.serve_wires [CASES] [SEED] [LANES] [SECONDS]

The faults are the emulators' own lists of knobs and deeds: a new knob is a new row of the matrix. Each case: bring the
kiosk to the step, turn the knob, wait until the kiosk has settled (playing, degraded, fault or off), look whether it
says why and what to do; then mend, and see it play again. CASES of the matrix are drawn (all of them without a number)
and shared among LANES processes, each with a kiosk of its own that goes on from case to case. Ends with 0 where every
case was explained and mended before its deadline, nothing hung, and no lamp was struck while it cooled.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from controller.errors import WorkError
from controller.serve.ports import Request
from controller.session.machine import State
from plugins.emulated.faults import WireFaults
from plugins.emulated.ptp_body import CameraFaults
from plugins.emulated.scenario import DEEDS, Event, Scenario, ScenarioPlayer
from tests.campaigns.kills import REPOSITORY, copy
from tests.campaigns.wired_kiosk import WiredKiosk, prepare_wired

SETTLED: Final = (State.PLAYING, State.DEGRADED, State.FAULT, State.OFF)
STEPS: Final = ("off", "powering", "warming", "playing", "calibrating", "degraded", "cooling")
REACH_S, SETTLE_S, MENDED_S, GAP_S = 120.0, 1000.0, 240.0, 30.0
"""Deadlines, for machines that do much else meanwhile: three strikes of a dead lamp alone take 105 s, and a lamp
that can't be switched off is a fault after 900 s."""
WORK_S: Final = 15.0
"""For so long work may go on after a fault; then somebody cancels it."""
NOTICED_S: Final = 25.0
"""By then a fault that lasts has been noticed where it matters; a short silence is no event for 15 s."""
FOR_S: Final = 8.0
"""How long a deed lasts that ends by itself."""
SLOW_S: Final = 2.0
MANY: Final = 1_000_000
TARGET: Final = "left"
Turn = Callable[[WiredKiosk], None]


@dataclass(frozen=True, slots=True)
class Fault:
    name: str
    strike: Turn
    mend: Turn
    lasts: bool = True


def values_of(knob: dataclasses.Field[Any]) -> tuple[Any, ...]:
    """What a knob is turned to, by its kind: a switch on, seconds, a count of one and one that does not end."""
    default = knob.default
    if isinstance(default, bool):
        return (not default,)
    return (SLOW_S,) if isinstance(default, float) else (1, MANY)


def wire_faults() -> Iterator[Fault]:
    """The knobs of a projector's wire."""
    for knob in dataclasses.fields(WireFaults):
        for value in values_of(knob):

            def strike(kiosk: WiredKiosk, name: str = knob.name, value: object = value) -> None:
                kiosk.projectors[TARGET].faults.set(**{name: value})

            yield Fault(f"wire {knob.name}={value}", strike, mend_projectors, value != 1)


def camera_faults() -> Iterator[Fault]:
    """The knobs of the camera."""
    for knob in dataclasses.fields(CameraFaults):
        for value in values_of(knob):

            def turn(kiosk: WiredKiosk, name: str = knob.name, value: object = value) -> None:
                setattr(kiosk.camera.faults, name, value)

            def back(kiosk: WiredKiosk, name: str = knob.name, value: object = knob.default) -> None:
                setattr(kiosk.camera.faults, name, value)

            yield Fault(f"camera {knob.name}={value}", turn, back, lasts=False)


def deeds() -> Iterator[Fault]:
    """What a script may do to a projector, for a while and for good; and to all of them at once."""
    for deed in DEEDS:
        for who in (TARGET, ""):
            for for_s in (FOR_S, 0.0):

                def strike(kiosk: WiredKiosk, do: str = deed, who: str = who, for_s: float = for_s) -> None:
                    for name, wire in kiosk.projectors.items():
                        scenario = Scenario((Event(do, who, at_s=0.0, for_s=for_s, delay_s=SLOW_S),))
                        wire.scenario = ScenarioPlayer(
                            scenario, device=name, faults=wire.faults, lamp=kiosk.lamps[name], plug=wire
                        )

                last = f"for {for_s:g} s" if for_s else "for good"
                yield Fault(f"{deed} of {who or 'everyone'} {last}", strike, mend_projectors, not for_s)


def mend_projectors(kiosk: WiredKiosk) -> None:
    """New lamps, whole cables, and a technician who says so."""
    for name, wire in kiosk.projectors.items():
        wire.scenario = None
        wire.faults.clear()
        wire.replug()
        if wire.wedged:
            wire.power_cycle()
        kiosk.lamps[name].mend()
    for keeper in kiosk.service.devices.projectors:
        keeper.forgive()


def processes() -> Iterator[Fault]:
    """The camera that is switched off, and the player that hangs or dies."""

    def nothing(kiosk: WiredKiosk) -> None:
        """It is started again by the service."""

    yield Fault("camera off", lambda kiosk: kiosk.camera.stop(), lambda kiosk: (kiosk.camera.start(), None)[1])
    yield Fault("camera connection lost", lambda kiosk: kiosk.camera.drop_connection(), nothing, lasts=False)
    yield Fault("player hung", lambda kiosk: kiosk.signal_player(signal.SIGSTOP), nothing, lasts=False)
    yield Fault("player killed", lambda kiosk: kiosk.signal_player(signal.SIGKILL), nothing, lasts=False)


def cases() -> list[tuple[str, Fault]]:
    """The matrix."""
    faults = (*wire_faults(), *camera_faults(), *deeds(), *processes())
    return [(step, fault) for step in STEPS for fault in faults]


def reach(kiosk: WiredKiosk, step: str) -> None:
    """Bring a playing kiosk to a step of its sequence. Raises AssertionError."""

    def state(*wanted: State) -> None:
        assert kiosk.until(lambda: kiosk.state in wanted, REACH_S), f"{step} was not reached: {kiosk.state.value}"

    conductor = kiosk.service.conductor
    if step in ("off", "powering", "warming", "cooling"):
        conductor.shut()
        state(State.COOLING, State.OFF)
    if step in ("off", "powering", "warming"):
        state(State.OFF)
    if step in ("powering", "warming"):
        conductor.open()
        state(State.POWERING, State.WARMING)
    if step == "warming":
        state(State.WARMING, State.READY, State.PLAYING)
    if step == "degraded":
        kiosk.lamps["right"].fail()
        state(State.DEGRADED)
    if step == "calibrating":
        assert kiosk.until(lambda: kiosk.service.devices.missing_for_work() is None, REACH_S), "nothing to work with"
        conductor.ask(Request("full", light=True))
        state(State.CALIBRATING)


def judge(kiosk: WiredKiosk, step: str, fault: Fault) -> None:
    """Reach, strike, wait, look; mend, wait, look again. Raises AssertionError."""
    assert kiosk.until_settled((State.PLAYING,), REACH_S), f"not playing before: {kiosk.state.value} {kiosk.reason}"
    kiosk.longest_gap_s, before = 0.0, kiosk.service.log.number
    reach(kiosk, step)
    fault.strike(kiosk)
    kiosk.until(lambda: kiosk.state in (State.DEGRADED, State.FAULT), NOTICED_S if fault.lasts else 2.0)
    _end_the_work(kiosk)
    assert kiosk.until_settled(SETTLED, SETTLE_S), f"does not settle: {kiosk.state.value} {kiosk.reason}"
    _explained(kiosk, before)
    fault.mend(kiosk)
    mend_projectors(kiosk)
    kiosk.service.conductor.open()
    assert kiosk.until_settled((State.PLAYING,), MENDED_S), f"not mended: {kiosk.state.value} {kiosk.reason}"
    assert not kiosk.sins, kiosk.sins
    assert max(kiosk.longest_gap_s, kiosk.silent_s) < GAP_S, f"nothing was decided for {kiosk.longest_gap_s:.0f} s"


def _end_the_work(kiosk: WiredKiosk) -> None:
    if kiosk.until(lambda: not kiosk.service.conductor.working, WORK_S):
        return
    try:
        kiosk.service.conductor.cancel()
    except WorkError:
        return  # it ended by itself meanwhile
    assert kiosk.until(lambda: not kiosk.service.conductor.working, SETTLE_S), "the work can't be cancelled"


def _explained(kiosk: WiredKiosk, before: int) -> None:
    """DEGRADED and FAULT say why, and the log says what to do."""
    if kiosk.state not in (State.FAULT, State.DEGRADED):
        return
    assert kiosk.reason.strip(), f"{kiosk.state.value} without a reason"
    told = [row for row in kiosk.service.log.after(before) if row.level != "info"]
    assert any(row.text.count(".") >= 2 for row in told), f"{kiosk.state.value} without a remedy: {told}"


def lane(stage: Path, most_s: float, numbers: list[int]) -> int:
    """Judge these cases one after the other on one kiosk, none begun after ``most_s``; a line of JSON for each."""
    matrix, failed, until_s = cases(), 0, time.monotonic() + most_s
    with WiredKiosk(stage) as kiosk:
        for number in numbers:
            if time.monotonic() > until_s:
                break
            step, fault = matrix[number]
            began_s, why = time.monotonic(), ""
            try:
                judge(kiosk, step, fault)
            except (AssertionError, WorkError) as error:
                why, failed = str(error) or type(error).__name__, failed + 1
                fault.mend(kiosk)
                mend_projectors(kiosk)
                kiosk.service.conductor.open()
                kiosk.sins.clear()
            row = {"case": f"{step}, {fault.name}", "seconds": round(time.monotonic() - began_s, 1), "wrong": why}
            print(json.dumps(row), flush=True)
    return failed


def campaign(numbers: list[int], lanes: int, folder: Path, *, most_s: float = 1e9) -> list[dict[str, Any]]:
    """Share the cases among so many processes; what each line said."""
    begun = prepare_wired(folder / "begun")
    words = [sys.executable, "-m", "tests.campaigns.serve_wires", "lane"]
    stages = [copy(begun, folder / f"lane-{number}") for number in range(min(lanes, len(numbers)))]
    rows: list[dict[str, Any]] = []
    with contextlib.ExitStack() as stack:
        running = []
        for number, stage in enumerate(stages):
            said = stack.enter_context((folder / f"lane-{number}.said").open("w"))
            command = [*words, str(stage), str(most_s), *map(str, numbers[number::lanes])]
            running.append(subprocess.Popen(command, stdout=said, cwd=REPOSITORY))
            stack.callback(running[-1].kill)
        for process in running:
            process.wait()
    for number, process in enumerate(running):
        told = [json.loads(line) for line in (folder / f"lane-{number}.said").read_text().splitlines()]
        rows += told
        if process.returncode not in (0, 1):
            rows.append({"case": f"a lane after {told[-1:]}", "wrong": f"it ended with {process.returncode}"})
    return rows


def main() -> int:
    if sys.argv[1:2] == ["lane"]:
        return min(1, lane(Path(sys.argv[2]), float(sys.argv[3]), [int(word) for word in sys.argv[4:]]))
    everything = list(range(len(cases())))
    count = int(sys.argv[1]) if len(sys.argv) > 1 else len(everything)
    seed, lanes = (int(sys.argv[2]) if len(sys.argv) > 2 else 1), (int(sys.argv[3]) if len(sys.argv) > 3 else 4)
    most_s = float(sys.argv[4]) if len(sys.argv) > 4 else 1e9
    drawn = random.Random(seed).sample(everything, min(count, len(everything)))
    began_s = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="wires") as folder:
        rows = campaign(drawn, lanes, Path(folder), most_s=most_s)
    wrong = [row for row in rows if row["wrong"]]
    print(Counter(row["case"].partition(",")[0] for row in rows))
    for row in wrong:
        print(f"WRONG: {row['case']}: {row['wrong']}")
    print(f"{len(rows)} of {len(everything)} cases, {len(wrong)} wrong, {time.monotonic() - began_s:.0f} s")
    return 1 if wrong or (len(rows) < len(drawn) and most_s == 1e9) else 0


if __name__ == "__main__":
    sys.exit(main())
