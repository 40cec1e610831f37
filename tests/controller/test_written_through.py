"""What is said to be done is on the disk: a power cut right after it takes nothing back.

Run as a program it does each piece of work once, and strace watches (``tests/written_through.py``).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
from nacl.signing import SigningKey

from controller.bundle import signing
from controller.bundle.describe import export_pictures
from controller.bundle.install import install
from controller.bundle.reader import Bundle
from controller.bundle.writer import NewAppearance
from controller.kiosk.backup import copied
from controller.kiosk.roles import Role
from controller.kiosk.store import archive, disk_space, settings
from controller.kiosk.store.accounts import Accounts
from controller.kiosk.store.event_log import EventLog
from controller.panel.auth.sessions import Sessions
from controller.run.journal import Journal
from controller.run.step_id import ShotId, StepId
from hal.notices import Notice
from tests.controller.bundle.conftest import OUTPUTS, write
from tests.controller.kiosk.vase import TEXT, graded_run, vase
from tests.shared import made_once
from tests.written_through import BEGIN, END, left_over, needs_strace

ROOT: Final = Path(__file__).parents[2]
RUN: Final = "20260601-100000-calibrate"
Work = Callable[[], object]


def written(path: Path) -> Path:
    """A file as any program leaves it: not synced."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"x" * 100)
    return path


def bundle(folder: Path) -> Path:
    pictures = {name: np.zeros((height, width, 3), np.uint8) for name, width, height in OUTPUTS}
    return write(folder / "a.vel", [NewAppearance("dark", pictures)], SigningKey(bytes(range(32))))


def works(stay: list[Any]) -> dict[str, Callable[[Path], Work]]:
    """Each piece of work by its name: it gets a folder of its own, prepares, and returns what is watched."""

    def a_line(place: Path) -> Work:
        stay.append(journal := Journal(place))
        return lambda: journal.record("retry", "attempt 1")

    def a_step(place: Path) -> Work:
        stay.append(journal := Journal(place))
        return lambda: journal.step(StepId("decode"), {"captures": "aa"}, lambda: [written(place / "runs/a.npz")])

    def a_shot(place: Path) -> Work:
        stay.append(journal := Journal(place))
        file = written(place / "white.dng")
        return lambda: journal.record_shot(ShotId("light", "white-00", "left"), {}, file)

    def an_event(place: Path) -> Work:
        stay.append(log := EventLog(place / EventLog.FILE))
        return lambda: log.add(Notice("x", "One."))

    def an_account(place: Path) -> Work:
        accounts = Accounts(place / "accounts.json")
        return lambda: accounts.add("vera", Role.VIEWER, "seven tall horses")

    def a_session(place: Path) -> Work:
        sessions = Sessions(place / "sessions.json")
        return lambda: sessions.begin("vera")

    def new_settings(place: Path) -> Work:
        stage = vase(place)
        return lambda: settings.save(stage, TEXT.replace("The vase", "Another"))

    def a_backup(place: Path) -> Work:
        stage = vase(place)
        return lambda: archive.backup(stage)

    def a_copy(place: Path) -> Work:
        file, disk = archive.backup(vase(place)), written(place / "disk/x").parent
        return lambda: copied(file, disk / "b.tar.gz")

    def a_restore(place: Path) -> Work:
        other = vase(place / "other")
        graded_run(other, RUN, {"left": 0.01})
        file = archive.backup(other)
        stage = vase(place / "stage")
        return lambda: archive.restore(stage, file)

    def photographs(place: Path) -> Work:
        run = graded_run(place, RUN, {"left": 0.01})
        written(run / "captures" / "a.dng")
        return lambda: disk_space.purge([run])

    def installed(place: Path) -> Work:
        file = bundle(place)
        return lambda: install(file, place / "bundles", allow_unsigned=True)

    def exported(place: Path) -> Work:
        file = bundle(place)
        return lambda: export_pictures(Bundle.open(file, allow_unsigned=True), place / "pictures")

    return {
        "a line of a journal": a_line,
        "a step with its artefact": a_step,
        "a photograph": a_shot,
        "an event": an_event,
        "an account": an_account,
        "a session": a_session,
        "a key": lambda place: lambda: signing.generate_key(place / "stage.key"),
        "settings": new_settings,
        "a backup": a_backup,
        "a backup on another disk": a_copy,
        "a restore": a_restore,
        "a bundle": lambda place: lambda: bundle(place),
        "an installed bundle": installed,
        "pictures of a bundle": exported,
        "photographs that go": photographs,
    }


def main(folder: Path) -> None:
    stay: list[Any] = []  # closed at the end: closing writes, too
    for name, prepare in works(stay).items():
        place = folder / name.replace(" ", "-")
        place.mkdir()
        work = prepare(place)
        os.write(1, f"{BEGIN}{name}\n".encode())
        work()
        os.write(1, f"{END}{name}\n".encode())


@needs_strace
@pytest.mark.slow
@pytest.mark.parametrize("name", works([]))
def test_it_is_on_the_disk_when_it_is_said_to_be_done(name: str, tmp_path_factory: pytest.TempPathFactory) -> None:
    _, found = made_once(
        tmp_path_factory,
        "written-through",
        lambda folder: left_over("tests.controller.test_written_through", [str(folder)], ROOT, folder),
    )
    assert found[name] == []


if __name__ == "__main__":
    main(Path(sys.argv[1]))
