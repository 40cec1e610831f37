"""Offering another version to a booted kiosk, and what becomes of it."""

from __future__ import annotations

import hashlib
import json
import subprocess
from pathlib import Path
from typing import Any, Final

from nacl.signing import SigningKey

from controller.bundle.signing import write_public_key
from controller.kiosk.install import update
from controller.kiosk.install.update import MARK, PROGRAM, RESULT, sign_package
from tests.booted.kiosk import Kiosk

_KEY: Final = SigningKey(bytes([1] * 32))
_PUBLIC: Final = Path("/opt/updates.pub")
_PLACE: Final = Path("/opt/update.deb")


def told(kiosk: Kiosk) -> dict[str, Any]:
    """The outcome of the last update."""
    file = kiosk.machine.at(RESULT)
    return dict(json.loads(file.read_text())) if file.exists() else {}


def put(kiosk: Kiosk, package: Path) -> str:
    """Sign this package for the kiosk, with a key that it trusts from then on; its SHA-256."""
    machine = kiosk.machine
    sign_package(package, _KEY, machine.at(_PLACE))
    if not machine.at(_PUBLIC).exists():
        write_public_key(machine.at(_PUBLIC), bytes(_KEY.verify_key))
        refused = machine.called("velatura", "kiosk", "update", _PLACE)
        assert "No key that this computer trusts" in refused.stdout + refused.stderr
        machine.call("velatura", "kiosk", "install", "--trust", _PUBLIC)
    with machine.at(_PLACE).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def ask(kiosk: Kiosk) -> subprocess.CompletedProcess[str]:
    """Ask the kiosk for an update by what was ``put`` there."""
    return kiosk.machine.called("velatura", "kiosk", "update", _PLACE)


def offer(kiosk: Kiosk, package: Path) -> str:
    """Sign this package, and update the kiosk by it; its SHA-256."""
    name = put(kiosk, package)
    asked = ask(kiosk)
    assert asked.returncode == 0, asked.stdout + asked.stderr
    kiosk.machine.at(_PLACE).unlink()
    kiosk.machine.wait_for(lambda: told(kiosk).get("name") == name)
    return name


def program(kiosk: Kiosk) -> str:
    """Which update the program there is of; empty for one that `dpkg` has installed."""
    mark = kiosk.machine.at(PROGRAM / MARK)
    return mark.read_text() if mark.exists() else ""


def stage_of_update(kiosk: Kiosk) -> str:
    """How far an update has come, by what lies on the disk; empty without one."""
    places = {update.TRIAL: "is on trial", update.PACKAGE: "is unpacked", update.OFFERED: "is checked"}
    return next((text for place, text in places.items() if kiosk.machine.at(place).exists()), "")


def outcome_of(kiosk: Kiosk) -> str:
    """Of the last update, in words."""
    found = told(kiosk)
    return f"{found['state']} {found['why']}".strip() if found else "none"


def a_day_later(kiosk: Kiosk) -> None:
    """Let the trial have begun a day ago. Its judge sees that from its next start on."""
    changed = told(kiosk)
    changed["began_unix_s"] -= update.WITHIN_S
    kiosk.machine.at(RESULT).write_text(json.dumps(changed))


def contents(program: Path) -> dict[str, str]:
    """SHA-256 of each file in the folder of a program, but of what follows from the others or states an update."""
    return {
        str(path.relative_to(program)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in program.rglob("*")
        if path.is_file() and not path.is_symlink() and path.suffix != ".pyc" and path.name != MARK
    }


def contents_of(package: Path, folder: Path) -> dict[str, str]:
    """As ``contents``, of a package, unpacked into the new ``folder``."""
    subprocess.run(["dpkg-deb", "--extract", package, folder], check=True)
    return contents(folder.joinpath(*PROGRAM.parts[1:]))
