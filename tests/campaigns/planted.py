"""How good the simulation is: bugs planted in a copy of the kiosk's code, and how many of them it finds.

    python -m tests.campaigns.planted [--seeds=NAME] [--log] [SECONDS] [WORD ...]

Each patch of ``planted_bugs`` is put into a copy of the code in a temporary folder. There, lives of one seed after
the other are lived, for at most so many seconds of a core; first without a bug, where nothing may be found. With
WORDs only the patches that have one in their names. ``--seeds``: lives that no one has looked at yet; ``--log``: lives
with incidents of the event log alone (``log_lives``). A search that fails does not stop the others; the exit
code is 1 then.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
BUGS = Path(__file__).parent / "planted_bugs"
PARTS = ("controller", "hal", "plugins", "firmware_configs")
LIVES = """
import sys, time
from lab.simulate.life import Life
from tests.campaigns.log_lives import log_life
number, days = 0, 0.0
while time.process_time() < float(sys.argv[1]):
    seed = f"{sys.argv[2]}-{number}"
    outcome = log_life(seed) if sys.argv[3] == "log" else Life(seed, 7.0).run()
    number, days = number + 1, days + outcome.at_s / 86400
    if outcome.violated:
        print(f"{outcome.violation} (seed {outcome.seed}, after {days:.1f} days)")
        sys.exit(9)
"""


@dataclass(frozen=True, slots=True)
class Found:
    """``violation``: of an invariant, empty if there was none; ``took_s``: seconds of a core."""

    bug: str
    violation: str
    took_s: float


def patches(words: Sequence[str] = ("",)) -> list[Path]:
    return sorted(path for path in BUGS.glob("*.patch") if any(word in path.stem for word in words))


def planted(patch: Path | None, folder: Path) -> Path:
    """A copy of the code in ``folder`` with this bug; None: without one."""
    for part in PARTS:
        shutil.copytree(ROOT / part, folder / part, ignore=shutil.ignore_patterns("__pycache__"))
    if patch is not None:
        # Without an offset or a line that differs: a patch of older code may plant another bug, or none.
        subprocess.run(["git", "apply", str(patch)], cwd=folder, check=True)
    return folder


def search(patch: Path | None, seconds: float, seeds: str = "planted", kind: str = "usual") -> Found:
    """Live until an invariant is violated, or the time is over; ``kind`` of lives: "usual" or "log"."""
    with tempfile.TemporaryDirectory() as name:
        copy = planted(patch, Path(name))
        before_s = os.times().children_user + os.times().children_system
        path = os.pathsep.join([str(copy), str(ROOT)])  # the copy's code first; of ROOT only the tests
        environment = {**os.environ, "PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1"}
        done = subprocess.run(
            [sys.executable, "-c", LIVES, str(seconds), seeds, kind],
            cwd=copy, env=environment, capture_output=True, text=True, check=False,
        )  # fmt: skip
        took_s = os.times().children_user + os.times().children_system - before_s
    if done.returncode not in (0, 9):
        raise RuntimeError(done.stderr[-2000:])
    return Found("" if patch is None else patch.stem, done.stdout.strip(), took_s)


def main() -> int:
    options = argparse.ArgumentParser()
    options.add_argument("--seeds", default="planted")
    options.add_argument("--log", dest="kind", action="store_const", const="log", default="usual")
    options.add_argument("seconds", nargs="?", type=float, default=120.0)
    options.add_argument("words", nargs="*")
    chosen = options.parse_args()
    seconds, words, seeds, kind = chosen.seconds, chosen.words, chosen.seeds, chosen.kind
    began_s, found, all_s = time.monotonic(), 0, 0.0
    if not words:
        control = search(None, seconds, seeds, kind)
        print(f"{control.took_s:6.0f} s  without a bug: {control.violation or 'nothing'}", flush=True)
    bugs = patches(words or [""])
    failed = 0
    for patch in bugs:
        try:
            one = search(patch, seconds, seeds, kind)
        except (RuntimeError, subprocess.CalledProcessError) as error:
            failed += 1
            print(f"         {patch.stem:42} FAILED: {str(error).strip().splitlines()[-1]}", flush=True)
            continue
        found += bool(one.violation)
        all_s += one.took_s
        print(f"{one.took_s:6.0f} s  {one.bug:42} {one.violation or 'NOT FOUND'}", flush=True)
    took_s = time.monotonic() - began_s
    print(f"{found} of {len(bugs)} found in {all_s:.0f} s of a core, {took_s:.0f} s here")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
