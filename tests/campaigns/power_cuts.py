"""Power cuts at random moments of a booted kiosk: its picture is back every time, and nothing is lost.

    python -m tests.campaigns.power_cuts [CUTS] [SEED] [SUITE] [SECONDS] [--part starting|work|update]

A kiosk on a bare Debian (bookworm) that plays. It is switched on, and all its processes are ended at once up to 20 s
later: while it boots, starts its services, opens its devices, or plays. So go three of four cuts. Then it calibrates,
and is cut off while it calibrates, and while it computes and publishes an appearance, in turn. After so many SECONDS
each part ends at its next cut. ``--part``: all CUTS are of this part. Hundred can be made in pieces of some minutes,
each with a SEED of its own. Ends with 0 where the picture came back every time, settings, key, bundle and every
event were there after each cut, and a calibration at the end ran through and its bundle plays.

``--part update``: it is updated again and again, and cut off meanwhile. After each cut one of the two versions plays,
with every file of its package; the next cut comes while the same update continues, until it has ended.

The devices are emulated on the same machine, and start again, too. So some boots beside devices that are on follow, for
the kiosk's own time.
"""

from __future__ import annotations

import argparse
import os
import random
import statistics
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from controller.kiosk.install.steps import DEBIAN
from controller.kiosk.install.update import PROGRAM
from tests.booted import updates
from tests.booted.kiosk import Kiosk, installed, prepared_stage
from tests.booted.machine import STAGE

LATEST_S: Final = 20.0
BOOTS: Final = 5
AT_WORK: Final = 0.25
"""Of all cuts."""
CALIBRATING_S: Final = 120.0
PUBLISHING_S: Final = 30.0
"""From the command to a moment after its end, on a computer that does much else."""
UPDATING_S: Final = 60.0
"""From the command, or from a boot, to a moment after the new version has been found to be well."""
KEPT: Final = ("stage.toml", "keys/stage.key")


def cut(kiosk: Kiosk, after_s: float) -> float:
    """Switch on and cut the power so long afterwards; the seconds from then on until a boot brings the picture back."""
    machine = kiosk.machine
    machine.cut_off()
    machine.switch_on()
    time.sleep(after_s)
    return cut_now(kiosk, kiosk.shows)


def cut_now(kiosk: Kiosk, shows: Callable[[], bool]) -> float:
    machine = kiosk.machine
    machine.cut_off()
    began_s = time.monotonic()
    machine.switch_on()
    machine.wait_for(shows)
    return time.monotonic() - began_s


def kept(kiosk: Kiosk) -> dict[str, bytes]:
    return {name: kiosk.machine.at(STAGE / name).read_bytes() for name in KEPT}


def lost(kiosk: Kiosk, before: dict[str, bytes]) -> list[str]:
    """What was there before and is not now."""
    now = kept(kiosk)
    gone = [name for name in KEPT if now[name] != before[name]]
    bundle = STAGE / "bundles" / "current"
    checked = kiosk.machine.called("velatura", "bundle", "verify", bundle, "--stage", STAGE, user="velatura")
    gone += ["bundle"] if checked.returncode else []
    events = set(kiosk.codes())
    return gone + ([] if "playing" in events else ["events"])


class Cuts:
    """Of one kiosk; ``ends_s``: when, on the monotonic clock, no other is begun."""

    def __init__(self, kiosk: Kiosk, seed: int, seconds: float) -> None:
        self.kiosk, self.seconds = kiosk, seconds
        self.back_s: list[float] = []
        self.gone: list[str] = []
        self._chance = random.Random(seed)

    def starting(self, cuts: int) -> None:
        """While it boots, starts and plays."""
        ends_s, before = time.monotonic() + self.seconds, kept(self.kiosk)
        for _ in range(cuts):
            if time.monotonic() > ends_s:
                break
            after_s = self._chance.uniform(0.0, LATEST_S)
            self._note(f"{after_s:.1f} s after it was switched on", cut(self.kiosk, after_s), lost(self.kiosk, before))

    def at_work(self, cuts: int) -> None:
        """While it calibrates and publishes, in turn."""
        machine = self.kiosk.machine
        ends_s = time.monotonic() + self.seconds
        for number in range(cuts):
            if time.monotonic() > ends_s:
                break
            machine.wait_for(lambda: self.kiosk.state == "playing" and not self.kiosk.problems())
            # A calibration takes longer, so each of two is cut off somewhere else.
            longest_s = PUBLISHING_S if number % 2 else CALIBRATING_S
            key, rows = machine.at(STAGE / KEPT[1]).read_bytes(), self.kiosk.events()
            if number % 2:
                self.kiosk.begin_appearance("new", number)
            else:
                self.kiosk.begin("calibrate")
            time.sleep(self._chance.uniform(0.0, longest_s))
            job = self.kiosk.status()["job"] or {}
            took_s = cut_now(self.kiosk, self.kiosk.shows_installed)
            lost_of_it = lost(self.kiosk, {**kept(self.kiosk), KEPT[1]: key})
            after = {row["number"]: row for row in self.kiosk.events()}
            lost_of_it += [f"event {row['number']}" for row in rows if after.get(row["number"]) != row]
            lost_of_it += [one for one in self.kiosk.status()["warnings"] if "settings" in one]
            self._note(f"while {_step(job)}", took_s, lost_of_it)

    def updating(self, cuts: int) -> None:
        """While it is updated to the other version, and to this one again; a trial is over after half of its cuts."""
        machine, ends_s = self.kiosk.machine, time.monotonic() + self.seconds
        packages = self.kiosk.packages
        with tempfile.TemporaryDirectory() as folder:
            whole = [updates.contents_of(package, Path(folder, str(n))) for n, package in enumerate(packages)]
        names, before, ended = {"": 0}, kept(self.kiosk), Counter[str]()
        for _ in range(cuts):
            if time.monotonic() > ends_s:
                break
            if not updates.stage_of_update(self.kiosk):
                ended[updates.outcome_of(self.kiosk)] += 1
                now = names[updates.program(self.kiosk)]
                names[updates.put(self.kiosk, packages[1 - now])] = 1 - now
                # The command takes some seconds, and ends with the machine.
                threading.Thread(target=updates.ask, args=(self.kiosk,)).start()
            time.sleep(self._chance.uniform(0.0, UPDATING_S))
            machine.cut_off()
            stage = updates.stage_of_update(self.kiosk) or "begins, or has ended"
            if updates.told(self.kiosk).get("state") == "trial" and self._chance.random() < 0.5:
                updates.a_day_later(self.kiosk)
            took_s = cut_now(self.kiosk, self.kiosk.shows)
            machine.wait_for(lambda: self.kiosk.state == "playing")
            plays = names.get(updates.program(self.kiosk))
            gone = lost(self.kiosk, before)
            if plays is None or updates.contents(machine.at(PROGRAM)) != whole[plays]:
                gone.append("program")
            self._note(f"while the update {stage}, version {plays} plays", took_s, gone)
        print("updates ended:", ", ".join(f"{count} {text}" for text, count in ended.items()))

    def _note(self, when: str, back_s: float, gone: list[str]) -> None:
        self.back_s.append(back_s)
        self.gone += gone
        found = f"lost: {', '.join(gone)}" if gone else "nothing lost"
        print(f"{len(self.back_s)}: cut {when}, back after {back_s:.1f} s, {found}; {_load()}", flush=True)


def _step(job: dict[str, Any]) -> str:
    if not job or job["ended"]:
        return "it plays, its work done"
    return f"{job['name']}: {job['steps'][-1]['title'] if job['steps'] else 'begins'}"


def main(cuts: int, seed: int, suite: str, seconds: float, part: str) -> int:
    at_work = {"both": round(AT_WORK * cuts), "work": cuts}.get(part, 0)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        stage = prepared_stage(folder)
        (folder / "machine").mkdir()
        versions = ("1", "2") if part == "update" else ("1",)
        with installed(suite, folder / "machine", versions=versions) as kiosk:
            kiosk.put_stage(stage)
            made = Cuts(kiosk, seed, seconds)
            if part == "update":
                made.updating(cuts)
            if part in ("both", "starting"):
                made.starting(cuts - at_work)
                shown_s = [kiosk.boot_beside_devices() for _ in range(BOOTS)]
                print(
                    f"{BOOTS} boots beside devices that are on: from X to the appearance {_spread(shown_s)}; {_load()}"
                )
                kiosk.machine.wait_for(lambda: kiosk.state == "playing")
            if part in ("both", "work"):
                kiosk.let_the_camera_see()
                kiosk.calibrate()
                made.at_work(at_work)
                calibrate_to_the_end(kiosk)
    print(f"{len(made.back_s)} cuts; lost: {made.gone or 'nothing'}; the picture was back after {_spread(made.back_s)}")
    return 1 if made.gone else 0


def calibrate_to_the_end(kiosk: Kiosk) -> None:
    """What power cuts broke would show here at the latest."""
    kiosk.machine.wait_for(lambda: kiosk.state == "playing" and not kiosk.problems())
    number = kiosk.events()[-1]["number"]
    kiosk.begin("calibrate")
    kiosk.machine.wait_for(lambda: {"calibrated", "published"} <= set(kiosk.codes(number)))
    kiosk.machine.wait_for(kiosk.shows_installed)


def _spread(took_s: list[float]) -> str:
    return f"{min(took_s):.1f} to {max(took_s):.1f} s, median {statistics.median(took_s):.1f} s"


def _load() -> str:
    return f"load {os.getloadavg()[0]:.1f}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cuts", type=int, nargs="?", default=100)
    parser.add_argument("seed", type=int, nargs="?", default=1)
    parser.add_argument("suite", choices=DEBIAN, nargs="?", default="bookworm")
    parser.add_argument("seconds", type=float, nargs="?", default=float("inf"))
    parser.add_argument("--part", choices=("both", "starting", "work", "update"), default="both")
    options = parser.parse_args()
    sys.exit(main(options.cuts, options.seed, options.suite, options.seconds, options.part))
