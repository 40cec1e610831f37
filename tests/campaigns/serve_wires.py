"""Every fault of every emulated device at every step of a kiosk, through real drivers on real wires, in real time.

    python -m tests.campaigns.serve_wires [CASES] [SEED] [LANES] [SECONDS] [SKIP] [WORD]

The faults are the emulators' own lists of knobs and deeds: a new knob is a new row of the matrix. Each case: bring the
kiosk to the step, turn the knob, wait until the kiosk has settled (playing, degraded, fault or off), look whether it
says why and what to do; then repair, and see it play again. CASES of the matrix are drawn (without a number: all)
and shared among LANES processes, each with a kiosk of its own that continues from case to case; SKIP leaves out so many
of the first that are drawn, so that a campaign can be done in parts, and WORD all whose names begin with another word
("board", "wire" ...). A new row does not change the order of the others. Ends with 0 where every case was explained and
repaired before its deadline, nothing hung, no lamp was struck while it cooled, and none lost its mains while hot.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any, Final

from controller.core.errors import WorkError
from controller.kiosk.decide.interfaces import Request
from controller.kiosk.state import EventRow
from controller.run.state_machine import State
from tests.campaigns.kills import REPOSITORY, copy
from tests.campaigns.usb_faults import WORDS, mend_usb, tether_faults, usb_faults, usb_well
from tests.campaigns.wired_faults import Fault, camera_faults, deeds, mend_projectors, processes, wire_faults
from tests.campaigns.wired_kiosk import WiredKiosk, prepare_wired, usb_environment

LANE: Final = (sys.executable, "-m", "tests.campaigns.serve_wires", "lane")
SETTLED: Final = (State.PLAYING, State.DEGRADED, State.FAULT, State.OFF)
STEPS: Final = ("off", "powering", "warming", "playing", "calibrating", "degraded", "cooling")
REACH_S, SETTLE_S, MENDED_S, GAP_S = 120.0, 300.0, 240.0, 30.0
"""Deadlines, for machines that do much else meanwhile: three strikes of a dead lamp alone take 105 s."""
WORK_S: Final = 15.0
"""For so long work may continue after a fault; then somebody cancels it."""
NOTICED_S: Final = 25.0
"""By then a fault that lasts has been noticed where it matters; a short silence is no event for 15 s."""
TOLD_S: Final = 90.0
"""By then a device that does not answer is reported: it is looked at every 10 s, with 20 s to open it."""
STARVED_S: Final = 1.0
"""Where the machine itself stood still for so long at once, a device may well have been late for our clock."""


def cases() -> list[tuple[str, Fault]]:
    """The matrix."""
    faults = (*wire_faults(), *camera_faults(), *deeds(), *processes(), *usb_faults(), *tether_faults())
    return [(step, fault) for step in STEPS for fault in faults]


def drawn(seed: int, word: str = "") -> list[int]:
    """The numbers of the cases whose faults begin with ``word``, in an order that new rows do not change."""
    matrix = cases()

    def place(number: int) -> bytes:
        step, fault = matrix[number]
        return hashlib.sha256(f"{seed} {step}, {fault.name}".encode()).digest()

    wanted = [number for number, (_, fault) in enumerate(matrix) if fault.name.startswith(word)]
    return sorted(wanted, key=place)


def reach(kiosk: WiredKiosk, step: str) -> None:
    """Bring a playing kiosk to a step of its sequence. Raises AssertionError."""

    def state(*wanted: State) -> None:
        assert kiosk.until(lambda: kiosk.state in wanted, REACH_S), f"{step} was not reached: {kiosk.state.value}"

    reconciler = kiosk.service.reconciler
    if step in ("off", "powering", "warming", "cooling"):
        reconciler.shut()
        state(State.COOLING, State.OFF)
    if step in ("off", "powering", "warming"):
        state(State.OFF)
    if step in ("powering", "warming"):
        reconciler.open()
        state(State.POWERING, State.WARMING)
    if step == "warming":
        state(State.WARMING, State.READY, State.PLAYING)
    if step == "degraded":
        kiosk.lamps["right"].fail()
        state(State.DEGRADED)
    if step == "calibrating":
        assert kiosk.until(lambda: kiosk.service.devices.missing_for_work() is None, REACH_S), "nothing to work with"
        reconciler.submit(Request("full", light=True))
        state(State.CALIBRATING)


def judge(kiosk: WiredKiosk, step: str, fault: Fault) -> None:
    """Reach, strike, wait, look; repair, wait, look again. Raises AssertionError."""
    assert kiosk.until(lambda: kiosk.state is State.PLAYING, REACH_S), f"not playing before: {kiosk.reason}"
    kiosk.longest_gap_s = kiosk.starved_s = 0.0
    before = kiosk.service.log.number
    reach(kiosk, step)
    struck = kiosk.service.log.number
    fault.strike(kiosk)
    if fault.told:
        assert kiosk.until(lambda: _told(kiosk, struck, fault.told), TOLD_S), f"nobody is told of the {fault.told}"
    kiosk.until(lambda: kiosk.state in (State.DEGRADED, State.FAULT), NOTICED_S if fault.lasts else 2.0)
    _end_the_work(kiosk)
    assert kiosk.until_settled(SETTLED, SETTLE_S), f"does not settle: {kiosk.state.value} {kiosk.reason}"
    _explained(kiosk, before)
    repair(kiosk, fault)
    assert kiosk.until_settled((State.PLAYING,), MENDED_S), f"not mended: {kiosk.state.value} {kiosk.reason}"
    assert kiosk.until(lambda: not usb_well(kiosk), MENDED_S), f"not mended: {usb_well(kiosk)}"
    if kiosk.starved_s < STARVED_S:
        _nothing_else(kiosk, before, fault)
    assert not kiosk.sins, kiosk.sins
    gap_s = max(kiosk.longest_gap_s, kiosk.silent_s) - kiosk.starved_s
    assert gap_s < GAP_S, f"nothing was decided for {gap_s:.0f} s"


def repair(kiosk: WiredKiosk, fault: Fault) -> None:
    """What a technician does: whatever is broken is whole again, and then Start."""
    fault.repair(kiosk)
    mend_usb(kiosk)
    mend_projectors(kiosk)
    kiosk.service.reconciler.open()


def _end_the_work(kiosk: WiredKiosk) -> None:
    if kiosk.until(lambda: not kiosk.service.reconciler.working, WORK_S):
        return
    try:
        kiosk.service.reconciler.cancel()
    except WorkError:
        return  # it ended by itself meanwhile
    assert kiosk.until(lambda: not kiosk.service.reconciler.working, SETTLE_S), "the work can't be cancelled"


def _explained(kiosk: WiredKiosk, before: int) -> None:
    """DEGRADED and FAULT say why, and the log says what to do."""
    if kiosk.state not in (State.FAULT, State.DEGRADED):
        return
    assert kiosk.reason.strip(), f"{kiosk.state.value} without a reason"
    told = kiosk.service.log.after(before)
    assert any(map(_remedied, told)), f"{kiosk.state.value} without a remedy: {told}"


def _told(kiosk: WiredKiosk, before: int, word: str) -> bool:
    return any(word in row.text and _remedied(row) for row in kiosk.service.log.after(before))


def _nothing_else(kiosk: WiredKiosk, before: int, fault: Fault) -> None:
    """No one was informed of a device to which nothing was done."""
    others = [word for name, word in WORDS.items() if name not in fault.name.split()]
    told = [row.text for row in kiosk.service.log.after(before) if row.level != "info"]
    wrong = [text for text in told if any(word in text for word in others)]
    assert not wrong, f"nothing is wrong with what is told of: {wrong}"


def _remedied(row: EventRow) -> bool:
    """Whether it is a warning that says what happened in one sentence, and in another what to do."""
    return row.level != "info" and row.text.count(".") >= 2


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
                repair(kiosk, fault)
                kiosk.sins.clear()
            row = {"case": f"{step}, {fault.name}", "seconds": round(time.monotonic() - began_s, 1),
                   "starved_s": round(kiosk.starved_s, 1), "wrong": why}  # fmt: skip
            print(json.dumps(row), flush=True)
    return failed


def campaign(numbers: list[int], lanes: int, folder: Path, *, most_s: float = 1e9) -> list[dict[str, Any]]:
    """Share the cases among so many processes, one more where some need a camera on USB; what each line said."""
    matrix = cases()
    rows: list[dict[str, Any]] = []
    with contextlib.ExitStack() as stack:
        running: list[subprocess.Popen[bytes]] = []
        for tethered in (False, True):
            some = [number for number in numbers if matrix[number][1].tethered is tethered]
            if not some:
                continue
            begun = prepare_wired(folder / f"begun-{tethered}", usb=True, tethered=tethered)
            count = min(len(some), max(1, round(lanes * len(some) / len(numbers))))
            for one in range(count):
                name = f"lane-{len(running)}"
                stage = copy(begun, folder / name)
                said = stack.enter_context((folder / f"{name}.said").open("w"))
                command = [*LANE, str(stage), str(most_s), *map(str, some[one::count])]
                usb = stack.enter_context(usb_environment())
                running.append(subprocess.Popen(command, stdout=said, cwd=REPOSITORY, env={**os.environ, **usb}))
                stack.callback(_end, running[-1])
        for process in running:
            process.wait()
    for number, process in enumerate(running):
        told = [json.loads(line) for line in (folder / f"lane-{number}.said").read_text().splitlines()]
        rows += told
        if process.returncode not in (0, 1):
            rows.append({"case": f"a lane after {told[-1:]}", "wrong": f"it ended with {process.returncode}"})
    return rows


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()


def main() -> int:
    if sys.argv[1:2] == ["lane"]:
        return min(1, lane(Path(sys.argv[2]), float(sys.argv[3]), [int(word) for word in sys.argv[4:]]))
    given = dict(enumerate(sys.argv[1:]))
    seed, lanes, skip = int(given.get(1, 1)), int(given.get(2, 4)), int(given.get(4, 0))
    everything = drawn(seed, given.get(5, ""))
    numbers = everything[skip : skip + int(given.get(0, len(everything)))]
    most_s, began_s = float(given.get(3, 1e9)), time.monotonic()
    with tempfile.TemporaryDirectory(prefix="wires") as folder:
        print(f"What each lane says: {folder}/lane-*.said", flush=True)
        rows = campaign(numbers, lanes, Path(folder), most_s=most_s)
    wrong = [row for row in rows if row["wrong"]]
    print(Counter(row["case"].partition(",")[0] for row in rows))
    for row in wrong:
        # Where the machine itself stood still for seconds, that is what was judged: run such a case again.
        print(f"WRONG: {row['case']}: {row['wrong']} (starved for {row.get('starved_s', 0):g} s)")
    print(f"{len(rows)} of {len(cases())} cases, {len(wrong)} wrong, {time.monotonic() - began_s:.0f} s")
    return 1 if wrong or (len(rows) < len(numbers) and most_s == 1e9) else 0


if __name__ == "__main__":
    sys.exit(main())
