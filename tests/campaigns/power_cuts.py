"""Power cuts at random moments of a booted kiosk: its picture is back every time, and nothing is lost.

    python -m tests.campaigns.power_cuts [CUTS] [SEED] [SUITE]

A kiosk on a bare Debian (bookworm) that plays. It is switched on, and all its processes are ended at once up to 20 s
later: while it boots, starts its services, opens its devices, or plays. Ends with 0 where the picture came back every
time, and settings, key, bundle and events were there at the end.

The devices are emulated on the same machine, and begin anew, too, which takes longer than all else. So some boots
beside devices that are on follow, for the kiosk's own time.
"""

from __future__ import annotations

import argparse
import os
import random
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Final

from controller.kiosk.install.steps import DEBIAN
from tests.booted.kiosk import Kiosk, installed, prepared_stage
from tests.booted.machine import STAGE

LATEST_S: Final = 20.0
BOOTS: Final = 5
KEPT: Final = ("stage.toml", "keys/stage.key")


def cut(kiosk: Kiosk, after_s: float) -> float:
    """Switch on and cut the power so long afterwards; the seconds from then on until a boot brings the picture back."""
    machine = kiosk.machine
    machine.cut_off()
    machine.switch_on()
    time.sleep(after_s)
    machine.cut_off()
    began_s = time.monotonic()
    machine.switch_on()
    machine.wait_for(kiosk.shows)
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
    events = {row["code"] for row in kiosk.machine.velatura("events")["events"]}
    return gone + ([] if "playing" in events else ["events"])


def main(cuts: int, seed: int, suite: str) -> int:
    chance = random.Random(seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        stage = prepared_stage(folder)
        (folder / "machine").mkdir()
        with installed(suite, folder / "machine") as kiosk:
            kiosk.put_stage(stage)
            before, back_s = kept(kiosk), list[float]()
            for number in range(cuts):
                after_s = chance.uniform(0.0, LATEST_S)
                back_s.append(cut(kiosk, after_s))
                print(f"{number + 1}: cut after {after_s:.1f} s, back after {back_s[-1]:.1f} s; {_load()}", flush=True)
            gone = lost(kiosk, before)
            shown_s = [kiosk.boot_beside_devices() for _ in range(BOOTS)]
    print(f"{cuts} cuts; lost: {gone or 'nothing'}; the picture was back after {_spread(back_s)}")
    print(f"{BOOTS} boots beside devices that are on: from X to the appearance {_spread(shown_s)}; {_load()}")
    return 1 if gone else 0


def _spread(took_s: list[float]) -> str:
    return f"{min(took_s):.1f} to {max(took_s):.1f} s, median {statistics.median(took_s):.1f} s"


def _load() -> str:
    return f"load {os.getloadavg()[0]:.1f}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cuts", type=int, nargs="?", default=100)
    parser.add_argument("seed", type=int, nargs="?", default=1)
    parser.add_argument("suite", choices=DEBIAN, nargs="?", default="bookworm")
    options = parser.parse_args()
    sys.exit(main(options.cuts, options.seed, options.suite))
