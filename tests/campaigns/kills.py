"""Power cuts at random moments of a calibration: it continues, and its bundle is the same to the byte.

    python -m tests.campaigns.kills [KILLS] [SEED] [SECONDS]

A calibration and its appearance on a small emulated stage, with real drivers over a pty, TCP and the player's socket.
SIGKILL ends the program and its player, and at every third kill the projectors and the camera, too: their lamps go
dark. What is left is started again, until there is a bundle; then the next calibration begins, from the same first
moment. Ends with 0 where every bundle was the one of a life without kills, no photograph was taken twice but one a
kill, and no lamp was struck while it cooled. After so many SECONDS no other calibration is begun.
"""

from __future__ import annotations

import collections
import contextlib
import importlib
import json
import os
import random
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Self

from tests.campaigns.mini_stage import APPEARANCE, prepare_mini, serve, taken
from tests.processes import children

REPOSITORY: Final = Path(__file__).parents[2]
LONGEST_S: Final = 0.3
"""Instead of 1.5 s, for which no display is late: the bench's pictures are there after 0.033 s."""
PATIENCE_S: Final = 900.0
BEGUN: Final = "begun"
DONE: Final = "installed"
READY: Final = '"ready"'
ALL_DARK_SHARE: Final = 0.35
EARLY_SHARE: Final = 0.1
LIVES_A_CALIBRATION: Final = 8.0
PORTS: Final = ("command_port", "event_port")


def work(stage: Path) -> int:
    """What a person would type, and type again: calibrate unless that is done, then the appearance."""
    from controller.optics.capture import latency
    from controller.run.progress import Silent
    from controller.stage.services.calibrate import AppearanceOrder, calibrate, make_appearances
    from controller.stage.sessions.calibrations import finished_calibrations
    from controller.stage.sessions.session import OwnSession
    from controller.stage.steps.capture import camera as camera_steps
    from controller.stage.steps.capture import patterns as capturing
    from controller.stage.steps.capture import photographs as shots

    for module in (latency, camera_steps, capturing, shots):
        vars(module)["LONGEST_S"] = LONGEST_S
    print(BEGUN, flush=True)
    cancel = threading.Event()
    if not finished_calibrations(stage):
        calibrate(session=OwnSession(stage), reporter=Silent(), cancel=cancel)
    make_appearances(AppearanceOrder(names=(APPEARANCE,)), session=OwnSession(stage), reporter=Silent(), cancel=cancel)
    print(DONE, flush=True)
    return 0


def say(record: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(record) + "\n")
    sys.stdout.flush()


class Nursery:
    """Forks our programs from a process that has imported everything, so that a life begins without waiting for it."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._count, self._lock = folder, 0, threading.Lock()
        self._popen = subprocess.Popen(
            [sys.executable, "-m", "tests.campaigns.kills", "nursery"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=REPOSITORY,
        )  # fmt: skip

    def begin(self, *words: str | Path) -> Process:
        """``work STAGE`` or ``bench STAGE EXPOSURES``."""
        assert self._popen.stdin is not None
        assert self._popen.stdout is not None
        with self._lock:
            self._count += 1
            out = self._folder / f"said-{self._count}"
            out.touch()
            self._popen.stdin.write(json.dumps([str(out), *map(str, words)]) + "\n")
            self._popen.stdin.flush()
            return Process(int(self._popen.stdout.readline()), out)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._popen.communicate(timeout=20)


def nursery() -> int:
    """Fork what each line asks for, and print its number; nothing here has threads."""
    for name in (
        "controller.stage.services.calibrate",
        "plugins.display.player",
        "plugins.ptp.camera",
        "plugins.projectors.serial",
    ):
        importlib.import_module(name)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    for line in sys.stdin:
        out, what, *words = json.loads(line)
        pid = os.fork()
        if pid == 0:
            os._exit(_life(Path(out), what, [Path(word) for word in words]))
        print(pid, flush=True)
    return 0


def _life(out: Path, what: str, words: Sequence[Path]) -> int:
    os.setsid()
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    with out.open("w") as said, Path(os.devnull).open() as nothing:
        os.dup2(nothing.fileno(), 0)
        for number in (1, 2):
            os.dup2(said.fileno(), number)
    try:
        return work(words[0]) if what == "work" else serve(words[0], words[1])
    except BaseException:  # noqa: BLE001 - a fork must end here, and say why
        traceback.print_exc()
        return 1
    finally:
        sys.stdout.flush()
        sys.stderr.flush()


class Process:
    """A program of ours, and what it says."""

    def __init__(self, pid: int, out: Path) -> None:
        self._pid, self._out = pid, out

    def until(self, word: str, seconds: float = PATIENCE_S) -> bool:
        """Wait for this word, or the end; whether it came."""
        until_s = time.monotonic() + seconds
        while not self.ended and word not in self.told and time.monotonic() < until_s:
            time.sleep(0.01)
        return word in self.told

    @property
    def told(self) -> str:
        return self._out.read_text()

    @property
    def ended(self) -> bool:
        return not Path(f"/proc/{self._pid}").exists()

    def kill(self) -> None:
        """SIGKILL to it and to all that it has started; stopped first, so that it starts no other meanwhile."""
        with contextlib.suppress(ProcessLookupError):
            os.kill(self._pid, signal.SIGSTOP)
        for pid in (*children(self._pid), self._pid):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        while not self.ended:
            time.sleep(0.005)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()


class Life:
    """A stage folder with the devices and the program that work on it."""

    def __init__(self, stage: Path, nursery: Nursery) -> None:
        self.stage, self._nursery = stage, nursery
        self.exposures = stage.parent / f"{stage.name}.exposures"
        self._bench: Process | None = None

    def __enter__(self) -> Self:
        self._powered()
        return self

    def __exit__(self, *_: object) -> None:
        self.cut_the_power()

    def _powered(self) -> None:
        if self._bench is None:
            self._bench = self._nursery.begin("bench", self.stage, self.exposures)
            assert self._bench.until(READY), self._bench.told

    def cut_the_power(self) -> None:
        if self._bench is not None:
            self._bench.kill()
            self._bench = None

    @contextlib.contextmanager
    def working(self) -> Iterator[Process]:
        self._powered()
        with self._nursery.begin("work", self.stage) as process:
            yield process

    def bundle(self) -> bytes:
        return (self.stage / "bundles" / "current").read_bytes()

    def exposed(self) -> collections.Counter[int]:
        """Exposures by how many photographs the journal held; the tries before the first do not count."""
        return collections.Counter(row["taken"] for row in self._notes() if row.get("taken", 0) > 0)

    def sins(self) -> list[str]:
        return [row["sin"] for row in self._notes() if "sin" in row]

    def _notes(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.exposures.read_text().splitlines() if line.endswith("}")]


@dataclass(frozen=True, slots=True)
class Lived:
    """What came of a calibration: its bundle, how often which photograph was taken, and what is wrong by itself.

    ``cuts``: of the ``kills``, those that put every device out, too.
    """

    bundle: bytes
    exposed: collections.Counter[int]
    wrong: tuple[str, ...]
    seconds: float
    kills: int = 0
    cuts: int = 0

    def repeated(self, whole: Lived) -> int:
        """Photographs that were taken again, without those of a life without kills."""
        return sum((self.exposed - whole.exposed).values())

    def differences(self, whole: Lived) -> list[str]:
        """What is not as in the life without kills."""
        wrong = list(self.wrong)
        if self.bundle != whole.bundle:
            wrong.append("the bundle is another one")
        if (again := self.repeated(whole)) > self.kills:
            wrong.append(f"{again} photographs were taken again after {self.kills} kills")
        if missing := whole.exposed - self.exposed:
            wrong.append(f"photographs were never taken: {dict(missing)}")
        return wrong


def begin(folder: Path, nursery: Nursery, *, photographs: int = 0) -> Path:
    """A stage whose calibration was killed when it had taken so many photographs: what all lives continue from."""
    begun = prepare_mini(folder / "begun")
    with Life(begun, nursery) as life, life.working() as process:
        while not (list((begun / "runs").glob("*/journal.sqlite")) and taken(begun) >= photographs):
            assert not process.ended, process.told
            time.sleep(0.02)
    return begun


def uninterrupted(stage: Path, nursery: Nursery) -> Lived:
    """Let it continue to its end."""
    with Life(stage, nursery) as life, life.working() as process:
        assert process.until(BEGUN), process.told
        began_s = time.monotonic()
        assert process.until(DONE), process.told
        return _lived(life, time.monotonic() - began_s, [])


def copy(begun: Path, to: Path) -> Path:
    """The stage at another place, its camera at other ports."""
    shutil.copytree(begun, to, symlinks=True)
    free = ports()
    for file in (to / "bench.toml", to / "stage.toml"):
        text = file.read_text()
        for old, new in zip(_ports_in(begun), free, strict=True):
            # Alone, not where its digits are a part of another number.
            text = re.sub(rf"(?<![\d.]){old}(?![\d.])", str(new), text)
        file.write_text(text)
    return to


def _ports_in(stage: Path) -> list[int]:
    rows = dict(line.partition(" = ")[::2] for line in (stage / "bench.toml").read_text().splitlines())
    return [int(rows[port]) for port in PORTS]


def ports() -> tuple[int, int]:
    """Two that no one listens on now, below those that the system hands out: they must be free again after a cut."""
    dice, found = random.SystemRandom(), list[int]()
    while len(found) < 2:
        with contextlib.suppress(OSError), socket.create_server(("127.0.0.1", dice.randrange(20_000, 32_000))) as one:
            found.append(int(one.getsockname()[1]))
    return found[0], found[1]


def killed(stage: Path, nursery: Nursery, dice: random.Random, most: int, longest_s: float) -> Lived:
    """Let it continue to its end, killed ``most`` times at most, each time within ``longest_s`` of its beginning."""
    kills = cuts = 0
    began_s = time.monotonic()
    with Life(stage, nursery) as life:
        while True:
            before = taken(stage)
            with life.working() as process:
                if kills >= most:
                    process.until(DONE)
                elif dice.random() < EARLY_SHARE:
                    process.until(DONE, dice.uniform(0.0, 2.0))
                else:
                    process.until(BEGUN)
                    process.until(DONE, dice.uniform(0.0, longest_s))
                ended = process.ended
                if DONE in process.told:
                    return _lived(life, time.monotonic() - began_s, [], kills, cuts)
                if ended or kills >= most:
                    return _lived(life, 0.0, [f"it ended by itself, or hung: {process.told}"], kills, cuts)
            kills += 1
            if dice.random() < ALL_DARK_SHARE:
                cuts += 1
                life.cut_the_power()
            longest_s *= 1.0 if taken(stage) > before else 1.15  # on a busy machine a step may take longer than a life


def _lived(life: Life, seconds: float, wrong: list[str], kills: int = 0, cuts: int = 0) -> Lived:
    runs = [path.name for path in (life.stage / "runs").iterdir() if path.name.endswith("-calibrate")]
    if len(runs) != 1:
        wrong.append(f"there are {len(runs)} calibrations")
    parts = [f"left behind: {path}" for path in life.stage.rglob("*.part")]
    return Lived(life.bundle(), life.exposed(), (*wrong, *life.sins(), *parts), seconds, kills, cuts)


@dataclass
class Sum:
    kills: int = 0
    cuts: int = 0
    repeated: int = 0
    calibrations: int = 0
    wrong: list[str] = field(default_factory=list)


def campaign(kills: int, seed: int, folder: Path, *, most_s: float = float("inf")) -> Sum:
    """So many kills, on as many calibrations as that takes."""
    dice, found, until_s = random.Random(seed), Sum(), time.monotonic() + most_s
    with Nursery(folder) as nursery:
        begun = begin(folder, nursery)
        whole = uninterrupted(copy(begun, folder / "whole"), nursery)
        while found.kills < kills and time.monotonic() < until_s:
            stage = copy(begun, folder / f"killed-{found.calibrations}")
            lived = killed(stage, nursery, dice, kills - found.kills, whole.seconds / LIVES_A_CALIBRATION)
            wrong, again = lived.differences(whole), lived.repeated(whole)
            say({"kills": lived.kills, "all dark": lived.cuts, "taken again": again, "wrong": wrong,
                 "seconds": round(lived.seconds)})  # fmt: skip
            found = Sum(found.kills + lived.kills, found.cuts + lived.cuts, found.repeated + again,
                        found.calibrations + 1, found.wrong + wrong)  # fmt: skip
            if not wrong:
                shutil.rmtree(stage)
    return found


def main() -> int:
    if sys.argv[1:2] == ["nursery"]:
        return nursery()
    kills = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    seed = int(sys.argv[2]) if len(sys.argv) > 2 else 1
    most_s = float(sys.argv[3]) if len(sys.argv) > 3 else float("inf")
    began_s = time.monotonic()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that what was forked is ended
    with tempfile.TemporaryDirectory(prefix="kills") as folder:
        done = campaign(kills, seed, Path(folder), most_s=most_s)
    print(f"{done.kills} kills ({done.cuts} with every device) in {done.calibrations} calibrations: {len(done.wrong)} "
          f"wrong, {done.repeated} photographs taken again, {time.monotonic() - began_s:.0f} s")  # fmt: skip
    return 1 if done.wrong else 0


if __name__ == "__main__":
    sys.exit(main())
