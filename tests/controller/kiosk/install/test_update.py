"""An update below another root: who may offer one, what judges it, and a power cut at any moment of it."""

from __future__ import annotations

import contextlib
import os
import random
import re
import shutil
import signal
import subprocess
import tracemalloc
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any, Final

import pytest
from nacl.signing import SigningKey

from controller.bundle.signing import write_public_key
from controller.core.errors import UsageError
from controller.kiosk.install import steps, update
from controller.kiosk.install.system import System
from controller.kiosk.install.update import OFFERED, PROGRAM, Updates, check_package, outcome, sign_package
from tests.controller.kiosk.install.test_kills import memory
from tests.controller.kiosk.store.test_backup_kills import OPERATIONS

__all__ = ("memory",)

KEY, OTHER_KEY = (SigningKey(bytes([number] * 32)) for number in (1, 2))
FILES = ("bin/velatura", "lib/controller/a.py", "lib/controller/b.py")
BEFORE = {"state": "playing", "drifts": [{"run": "1", "advice": "nothing"}], "grades": [{"run": "1", "grade": "A"}]}


def program(folder: Path, version: str) -> None:
    for name in FILES:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(version)


def debian_package(
    folder: Path, version: str, *, depends: str = "python3 (>= 3.11), libxext6", changelog: str = ""
) -> Path:
    tree = folder / f"tree-{version}"
    program(tree / "opt/velatura", version)
    (tree / "DEBIAN").mkdir()
    fields = f"Package: velatura\nVersion: {version}\nArchitecture: all\nMaintainer: x\nDescription: x\n"
    (tree / "DEBIAN/control").write_text(f"{fields}Depends: {depends}\n")
    if changelog:
        (tree / "DEBIAN" / update.CHANGELOG).write_text(changelog)
    file = folder / f"velatura_{version}.deb"
    subprocess.run(["dpkg-deb", "-Znone", "--build", tree, file], check=True, stdout=subprocess.DEVNULL)
    sign_package(file, KEY, file)
    return file


class Computer(System):
    """Its kiosk reports what ``reports`` has for the version that is installed, one after the other, the last for
    ever. Unpacking copies a folder instead where ``copies`` is one.
    """

    def __init__(self, root: Path, reports: Mapping[str, list[Any]], copies: Path | None = None) -> None:
        self.told: list[str] = []
        super().__init__(self.told.append, root=root)
        self.reports, self._copies = {version: list(rows) for version, rows in reports.items()}, copies
        self.waited_s, self.asks_apt = 0.0, False

    def run(self, *words: str, may_fail: bool = False) -> None:
        if words[0] == "dpkg-deb" and self._copies is not None:
            shutil.copytree(self._copies, Path(words[-1]) / "opt/velatura")
        elif words[0] == "dpkg-deb":
            super().run(*words)
        else:
            self.told.append(f"{self.version}: {' '.join(words)}")

    def look(self, *words: str, more: Mapping[str, str] | None = None) -> str | None:
        return "" if words[0] == "apt-get" and not self.asks_apt else super().look(*words, more=more)

    @property
    def version(self) -> str:
        """The one version of which all files are."""
        (version,) = {(self.at(PROGRAM) / name).read_text() for name in FILES}
        return version

    def status(self) -> Any:
        rows = self.reports[self.version]
        return rows.pop(0) if len(rows) > 1 else rows[0]

    def _wait(self, seconds: float) -> None:
        self.waited_s += seconds

    def boot(self) -> None:
        """What the service does as long as its path unit starts it: offered, unfinished or not."""
        unit = steps.shipped(PROGRAM)[Path("/etc/systemd/system") / steps.UPDATES]
        places = [self.at(Path(place)) for place in re.findall(r"^PathExists=(\S+)$", unit, re.MULTILINE)]
        while any(map(os.path.lexists, places)):
            Updates(self, status=self.status, wait=self._wait, now=lambda: 1.8e9 + self.waited_s).run()


def offered(root: Path, package: Path) -> None:
    for place in (PROGRAM, OFFERED.parent, steps.TRUSTED):
        (root / place.relative_to("/")).mkdir(parents=True)
    program(root / "opt/velatura", "1")
    write_public_key(root / "etc/velatura/update-keys/house.pub", bytes(KEY.verify_key))
    shutil.copy(package, root / OFFERED.relative_to("/"))


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return debian_package(tmp_path_factory.mktemp("package"), "2")


def report(**changed: Any) -> dict[str, Any]:
    return {**BEFORE, **changed}


CHECKED = report(drifts=[{"run": "2", "advice": "nothing"}])


def test_a_signed_package_is_one_that_dpkg_still_reads(package: Path) -> None:
    for what in ("--contents", "--info"):
        subprocess.run(["dpkg-deb", what, package], check=True, stdout=subprocess.DEVNULL)
    before = package.read_bytes()
    sign_package(package, KEY, package)
    assert package.read_bytes() == before, "a signature takes the place of an old one"


NEWER: Final = """# Changelog

## Unreleased

- A third thing, which
  needs two lines.

## 2.0 (2026-12-01)

- A second thing.

## 1.0 (2026-11-01)

- A first thing.
"""


@pytest.mark.parametrize(
    ("text", "versions", "said"),
    [
        (NEWER, ["2.0"], ["A third thing, which needs two lines."]),
        (NEWER, ["2.0", "1.0"], ["A third thing, which needs two lines.", "A second thing."]),
        (NEWER, ["Unreleased"], ["The changelog of the package has nothing newer."]),
        (NEWER, ["0.9", "2.0"], ["The package does not say what has changed since version 0.9."]),
        ("", ["1.0"], ["The package does not say what has changed since version 1.0."]),
    ],
)
def test_what_is_new_is_everything_above_the_oldest_version(text: str, versions: list[str], said: list[str]) -> None:
    assert update.news(text, versions) == said


def test_an_update_says_what_is_new_before_it_is_carried_out(tmp_path: Path) -> None:
    here = metadata.version("velatura")
    for name, text, said in (
        ("with", f"## 9.0\n\n- It sings.\n\n## {here} (2026-11-25)\n\n- It hums.\n", ["It sings."]),
        ("without", "", [f"The package does not say what has changed since version {here}."]),
    ):
        folder = tmp_path / name
        folder.mkdir()
        computer = Computer(folder / "root", {})
        assert update.changes(computer, debian_package(folder, "9.0-1", changelog=text))["news"] == said


def test_a_large_package_is_signed_and_checked_in_parts(tmp_path: Path) -> None:
    file, trusted = tmp_path / "large.deb", tmp_path / "trusted"
    trusted.mkdir()
    write_public_key(trusted / "house.pub", bytes(KEY.verify_key))
    with file.open("wb") as made:
        made.truncate((48 << 20) + 1)
    tracemalloc.start()
    try:
        for _ in range(2):
            sign_package(file, KEY, file)
            check_package(file, trusted)
        assert tracemalloc.get_traced_memory()[1] < 8 << 20
    finally:
        tracemalloc.stop()


def test_a_package_for_another_debian_is_refused_before_anything_changes(tmp_path: Path) -> None:
    (tmp_path / "made").mkdir()
    offered(tmp_path, debian_package(tmp_path / "made", "2", depends="python3 (>= 3.99), python3 (<< 3.99.99)"))
    computer = Computer(tmp_path, {"1": [BEFORE]})
    computer.asks_apt = True
    computer.boot()
    assert computer.version == "1"
    told = outcome(computer)
    assert (told.name, told.state) == ("", "failed")
    assert "python3 (>= 3.99)" in told.why
    assert [line for line in computer.told if "dpkg-deb" in line] == []
    package = debian_package(tmp_path / "made", "3", depends="libc6 (>= 2.2) | no-such-package")
    assert update.needs(computer, package) == []


def test_an_update_starts_proves_itself_and_stays(tmp_path: Path, package: Path) -> None:
    offered(tmp_path, package)
    players = tmp_path / "var/lib/velatura/stage/keys/players"
    players.mkdir(parents=True)
    computer = Computer(tmp_path, {"1": [BEFORE], "2": [None, report(state="warming"), BEFORE, CHECKED]})
    assert update.changes(computer, package)["changed"] == sorted(FILES)
    computer.boot()
    assert computer.version == "2"
    assert "2: /opt/velatura/bin/velatura kiosk install --restart" in computer.told
    told = outcome(computer)
    assert (told.state, told.before) == ("done", BEFORE)
    left = sorted(path.name for path in (tmp_path / "opt").iterdir())
    assert left == ["velatura", "velatura.other", "velatura.starts", "velatura.update"]
    assert not computer.at(OFFERED).exists()
    # The other computers of its stage get it now.
    assert (players / "update.deb").read_bytes() == package.read_bytes()
    # Another one takes the place of the former version.
    shutil.copy(package, computer.at(OFFERED))
    computer.boot()
    assert (computer.version, outcome(computer).state) == ("2", "done")


@pytest.mark.parametrize(
    ("reports", "why"),
    [
        ([None], "does not answer"),
        ([report(state="fault")], "fault"),
        ([report(state="warming")], "played before, and is in the state warming"),
        ([BEFORE, report(drifts=[{"run": "2", "advice": "full"}])], "drift check was worse: full instead of nothing"),
        ([BEFORE, report(grades=[{"run": "2", "grade": "D"}])], "grade was worse: D instead of A"),
        ([report(state="off")], "not played since"),
    ],
)
def test_a_version_that_is_worse_is_taken_back(tmp_path: Path, package: Path, reports: list[Any], why: str) -> None:
    offered(tmp_path, package)
    computer = Computer(tmp_path, {"1": [BEFORE], "2": reports})
    computer.boot()
    told = outcome(computer)
    assert (computer.version, told.state) == ("1", "failed")
    assert why in told.why
    assert computer.told[-1] == "1: /opt/velatura/bin/velatura kiosk install --restart"
    assert computer.waited_s <= update.WITHIN_S + 120


def test_without_a_check_a_version_that_plays_stays_after_a_day(tmp_path: Path, package: Path) -> None:
    offered(tmp_path, package)
    computer = Computer(tmp_path, {"1": [BEFORE], "2": [BEFORE, report(state="off")]})
    computer.boot()
    assert (computer.version, outcome(computer).state) == ("2", "done")
    assert computer.waited_s == pytest.approx(update.WITHIN_S, abs=120)


def test_a_computer_that_only_plays_stays_one(tmp_path: Path, package: Path) -> None:
    offered(tmp_path, package)
    wanted = tmp_path / "etc/systemd/system/velatura.target.wants"
    wanted.mkdir(parents=True)
    (wanted / "velatura-agent.service").symlink_to("/etc/systemd/system/velatura-agent.service")
    # Its agent is back, then its player.
    computer = Computer(tmp_path, {"1": [{"state": "playing"}], "2": [None, {"state": "off"}, {"state": "playing"}]})
    computer.boot()
    assert (computer.version, outcome(computer).state) == ("2", "done")
    assert "2: /opt/velatura/bin/velatura kiosk install --player --restart" in computer.told


def test_what_no_trusted_key_has_signed_changes_nothing(tmp_path: Path, package: Path) -> None:
    data = package.read_bytes()
    wrong = {"unsigned": data[:-188], "cut": data[:-1], "changed": data[:100] + b"x" + data[101:], "empty": b""}
    for number, (name, content) in enumerate(wrong.items()):
        root = tmp_path / str(number)
        offered(root, package)
        computer = Computer(root, {"1": [BEFORE]})
        computer.at(OFFERED).write_bytes(content)
        computer.boot()
        assert (computer.version, outcome(computer).state) == ("1", "failed"), name
        assert "signed" in outcome(computer).why
        assert not computer.at(OFFERED).exists()
    strange = tmp_path / "strange.deb"
    sign_package(package, OTHER_KEY, strange)
    for trusted in (tmp_path / "0/etc/velatura/update-keys", tmp_path / "none"):
        with pytest.raises(UsageError) as caught:
            check_package(strange, trusted)
        assert caught.value.code == "update-not-trusted"


def test_a_package_that_is_a_link_is_not_followed(tmp_path: Path, package: Path) -> None:
    offered(tmp_path, package)
    place = tmp_path / OFFERED.relative_to("/")
    place.unlink()
    place.symlink_to(package)
    computer = Computer(tmp_path, {"1": [BEFORE]})
    computer.boot()
    assert (computer.version, outcome(computer).state, package.exists()) == ("1", "failed", True)


def killed(computer: Computer, moment: int) -> bool:
    """Boot in a process that gets SIGKILL before its operation of this number; whether it did."""
    child = os.fork()
    if child == 0:
        left = [moment]

        def counted(real: Any) -> Any:
            def operation(*given: Any, **more: Any) -> Any:
                if left[0] == 0:
                    os.kill(os.getpid(), signal.SIGKILL)
                left[0] -= 1
                return real(*given, **more)

            return operation

        for name in (*OPERATIONS, "open"):
            setattr(os, name, counted((lambda *_: None) if name == "fsync" else getattr(os, name)))
        os.sync = lambda: None
        try:
            computer.boot()
        finally:
            os._exit(0)
    return os.WIFSIGNALED(os.waitpid(child, 0)[1])


@pytest.mark.parametrize("good", [True, False])
def test_a_power_cut_at_a_drawn_moment_leaves_one_of_the_two(
    memory: Path, package: Path, good: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "sync", lambda: None)
    program(memory / "new", "2")
    offered(memory / "first", package)
    reports: dict[str, list[Any]] = {"1": [BEFORE], "2": [CHECKED if good else None]}
    draws, cuts, ends = random.Random(7), 0, set()
    for number in range(50):
        root = memory / str(number)
        shutil.copytree(memory / "first", root)
        while killed(Computer(root, reports, memory / "new"), draws.randrange(90)):
            cuts += 1
            assert Computer(root, reports).version in "12", "whole after each power cut"
        computer = Computer(root, reports, memory / "new")
        computer.boot()
        ends.add((computer.version, outcome(computer).state))
        assert not any(computer.at(place).exists() for place in (update.TRIAL, update.PACKAGE, OFFERED))
        shutil.rmtree(root)
    assert cuts >= 50
    assert ends == {("2", "done") if good else ("1", "failed")}


def test_a_version_that_stops_the_computer_is_taken_back(tmp_path: Path, package: Path) -> None:
    offered(tmp_path, package)

    class Stops(Computer):
        def run(self, *words: str, may_fail: bool = False) -> None:
            super().run(*words, may_fail=may_fail)
            if words[0] != "dpkg-deb" and self.version == "2":
                raise KeyboardInterrupt

    starts = 0
    while Computer(tmp_path, {}).at(update.PROGRAM / update.MARK).exists() or starts == 0:
        starts += 1
        assert starts < 6
        with contextlib.suppress(KeyboardInterrupt):
            Stops(tmp_path, {"1": [BEFORE], "2": [BEFORE]}).boot()
    computer = Computer(tmp_path, {})
    assert (computer.version, outcome(computer).state) == ("1", "failed")
    assert "started 3 times" in outcome(computer).why


def test_the_service_runs_the_former_version_while_one_is_judged(tmp_path: Path) -> None:
    text = steps.shipped(PROGRAM)[Path("/etc/systemd/system/velatura-update.service")]
    (command,) = (line for line in text.splitlines() if line.startswith("ExecStart="))
    script = command.partition(" -c ")[2].strip("'").replace("/opt/velatura", f"{tmp_path}/velatura")
    for name, mark in (("velatura", "new"), ("velatura.other", None)):
        (tmp_path / name / "bin").mkdir(parents=True)
        (tmp_path / name / "bin/python").write_text(f"#!/bin/sh\necho {name}\n")
        (tmp_path / name / "bin/python").chmod(0o755)
        if mark:
            (tmp_path / name / ".update").write_text(mark)
    for trial, runs in ((None, "velatura"), ("new", "velatura.other"), ("another", "velatura")):
        if trial is not None:
            (tmp_path / "velatura.trial").write_text(trial)
        done = subprocess.run(["sh", "-c", script], capture_output=True, text=True, check=True)
        assert done.stdout.split() == [runs]
