"""An installation that is killed before any of its operations, and typed again, ends as one that was not."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from nacl.signing import SigningKey

from controller.core.errors import UsageError
from controller.core.kiosk_places import PLAYER_OPTIONS, STAGE
from controller.kiosk.install import restored, steps
from hal.registry import load_drivers
from tests.controller.kiosk.install.test_restored import backup, never, stage_text, told_by_x
from tests.controller.kiosk.install.test_steps import FRESH, PREFIX, THERE, Recorded
from tests.controller.kiosk.store.test_backup_kills import Killed, Operations
from tests.controller.play.display.xorg import edid

OS_RELEASE = 'VERSION_ID="12"\nID=debian\n'


class Computer:
    """A bare Debian: its files lie in ``root``; what its programs did with them is noted."""

    def __init__(self, root: Path, answers: Mapping[str, str]) -> None:
        self.root, self.answers = root, dict(answers)
        self.owners: dict[Path, str] = {}
        self.programs: dict[str, Any] = defaultdict(str)
        (root / "etc").mkdir(parents=True)
        (root / "etc/os-release").write_text(OS_RELEASE)

    def state(self) -> dict[str, Any]:
        """All that counts: content, rights and owner of each file, and with which of them the services run."""
        places = {path: path.lstat() for path in self.root.rglob("*") if not path.name.endswith((".new", ".part"))}
        files = {
            str(path.relative_to(self.root)): (
                path.read_bytes() if path.is_file() else "",
                found.st_mode,
                self.owners.get(path, ""),
            )
            for path, found in places.items()
        }
        return files | self.programs

    def has(self, *paths: Path) -> str:
        return "".join(one.read_text() for path in paths if (one := self.root / path.relative_to("/")).exists())


class Session(Recorded):
    """One call of the command on ``computer``; a program that is run is an operation, too."""

    def __init__(self, computer: Computer) -> None:
        super().__init__(computer.root, computer.answers)
        self.computer = computer

    def run(self, *words: str, may_fail: bool = False) -> None:
        os.utime(self.at(Path("/etc/os-release")))  # an operation that is counted
        super().run(*words, may_fail=may_fail)
        computer, programs = self.computer, self.computer.programs
        match words:
            case ("useradd", *_):
                computer.answers["getent"] = THERE["getent"]
            case ("usermod", *_):
                computer.answers["id"] = THERE["id"]
            case ("apt-get", "install", *_):
                computer.answers["dpkg-query"] = THERE["dpkg-query"]
            case ("openssl", *_):
                os.utime(self.at(steps.KEY))  # the key is there, and the certificate is not
                self.write(steps.CERTIFICATE, "a certificate")
            case ("chown", "--recursive", owner, folder):
                computer.owners |= dict.fromkeys(self.at(Path(folder)).rglob("*"), owner)
            case ("chown" | "chmod", how, path):
                programs[f"{words[0]} {path}"] = how
            case ("systemctl", "daemon-reload"):
                programs["units"] = [text for path, text in steps.shipped(PREFIX).items() if self.read(path) == text]
            case ("systemctl", "start" | "restart" | "try-restart" | "stop" as verb, *units):
                for unit in units:
                    self.service(verb, unit)

    def service(self, verb: str, unit: str) -> None:
        if unit == steps.TARGET:
            for one in steps.SERVICES:
                self.service(verb, one)
            return
        reads = {"velatura-x11": (steps.X_OUTPUTS,), "velatura-player": (PLAYER_OPTIONS,)}
        runs = self.computer.programs[unit]
        if verb == "stop":
            self.computer.programs[unit] = ""
        elif verb == "restart" or bool(runs) == (verb == "try-restart"):
            files = reads.get(unit, (steps.KEY, steps.CERTIFICATE, steps.CONTROLLER_OPTIONS, STAGE / "stage.toml"))
            units = self.computer.programs["units"]
            self.computer.programs[unit] = f"{len(units)} units, {self.computer.has(*files)}"

    def _own(self, place: Path, owner: str) -> None:
        os.utime(place)
        self.computer.owners[place.with_name(place.name[1:].removesuffix(".new"))] = owner


@pytest.fixture
def memory(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder in memory where there is one: to wait for a real disk some thousand times is slow."""
    monkeypatch.setattr(os, "fsync", lambda handle: None)
    place = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=place if os.access(place, os.W_OK) else None) as folder:
        yield Path(folder)


def install(computer: Computer) -> None:
    session = Session(computer)
    steps.install(session, outputs_again=False, restart=False, say=session.told.append, prefix=PREFIX)


def every_kill(tmp_path: Path, answers: Mapping[str, str], work: Callable[[Computer], None], step: int) -> None:
    """Kill ``work`` before each operation, do it again, and compare."""
    whole = Computer(tmp_path / "whole", answers)
    with pytest.MonkeyPatch.context() as patch:
        operations = Operations(patch)
        work(whole)
    count = len(operations.done)
    assert count > 60
    for moment in [*range(0, count - 40, step), *range(count - 40, count)]:
        shutil.rmtree(tmp_path / "killed", ignore_errors=True)
        computer = Computer(tmp_path / "killed", answers)
        with pytest.MonkeyPatch.context() as patch:
            Operations(patch, moment)
            with contextlib.suppress(Killed):
                work(computer)
        work(computer)
        assert computer.state() == whole.state(), f"killed before operation {moment}"


@pytest.mark.slow
def test_an_installation(memory: Path) -> None:
    every_kill(memory, FRESH, install, 3)


@pytest.mark.slow
def test_a_backup_on_a_blank_computer(tmp_path: Path, memory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drivers = load_drivers(benches=False)
    monkeypatch.setattr("controller.stage.sessions.check.load_drivers", lambda **_: drivers)
    monkeypatch.setattr("controller.kiosk.install.restored.os.sync", lambda: None)
    monkeypatch.setattr("controller.bundle.signing.SigningKey.generate", lambda: SigningKey(bytes(32)), raising=False)
    file = backup(tmp_path, stage_text("A1", "B2", "C3"))
    now = told_by_x(*((f"DP-{n}", edid(one, n)) for n, one in enumerate(("A1", "B2", "C3"), 1)))

    def work(computer: Computer) -> None:
        session = Session(computer)
        # Where it was killed after its last step, the stage is there.
        with contextlib.suppress(UsageError):
            restored.restore(session, file, ask=never, say=session.told.append, prefix=PREFIX)

    every_kill(memory, {**FRESH, "xrandr": now}, work, 37)
