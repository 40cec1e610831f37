"""A USB stick is found by the label or UUID of its file system; a full one is one message."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from controller.config.models import BackupTable
from controller.core.errors import WorkError
from controller.kiosk.backup import NightlyBackup, Stick
from controller.kiosk.store import archive
from controller.kiosk.store.event_log import EventLog
from tests.controller.kiosk.backup.test_nightly import NIGHT_S
from tests.controller.kiosk.vase import vase


class Computer:
    """What udev and the kernel report of a stick, as files below a root."""

    def __init__(self, folder: Path) -> None:
        self.root, self.stick = folder / "root", folder / "a stick"
        self.stick.mkdir()
        for name in ("dev/disk/by-label", "dev/disk/by-uuid", "proc/self"):
            (self.root / name).mkdir(parents=True)
        (self.root / "proc/self/mountinfo").write_text("22 1 8:1 / / rw,relatime shared:1 - ext4 /dev/sda1 rw\n")

    def plug(self) -> None:
        (self.root / "dev/sdb1").touch()
        (self.root / "dev/disk/by-label/NIGHT\\x20BACKUP").symlink_to("../../sdb1")
        (self.root / "dev/disk/by-uuid/4F2A-11B0").symlink_to("../../sdb1")

    def mount(self) -> None:
        place = str(self.stick).replace(" ", "\\040")
        with (self.root / "proc/self/mountinfo").open("a") as file:
            file.write(f"90 22 8:17 / {place} rw,nosuid shared:40 - vfat /dev/sdb1 rw,uid=1000\n")


@pytest.mark.parametrize("label", ["NIGHT BACKUP", "4F2A-11B0"])
def test_it_is_found_wherever_it_is_mounted(tmp_path: Path, label: str) -> None:
    computer, stage = Computer(tmp_path), vase(tmp_path / "stage")
    source, place = archive.backup(stage), Stick(label, stage, computer.root)
    with pytest.raises(WorkError, match="is not plugged in") as caught:
        place.store(source, "20260504", 2)
    assert caught.value.code == "backup-stick-missing"
    computer.plug()
    with pytest.raises(WorkError, match="not mounted") as caught:
        place.store(source, "20260504", 2)
    assert caught.value.code == "backup-stick-not-mounted"
    computer.mount()
    told = place.store(source, "20260504", 2)
    assert f"on the USB stick {label}" in told.what
    assert [path.name for path in computer.stick.iterdir()] == ["velatura-20260504.tar.gz"]
    archive.check_backup(computer.stick / "velatura-20260504.tar.gz")


FULL = """
import json, subprocess, sys
from pathlib import Path
from tests.controller.kiosk.backup.test_stick import Computer, a_night
place = Path(sys.argv[1])
computer = Computer(place)
subprocess.run(["mount", "-t", "tmpfs", "-o", "size=300k", "none", str(computer.stick)], check=True)
computer.plug()
computer.mount()
print(json.dumps(a_night(place, computer)))
"""


def a_night(place: Path, computer: Computer) -> dict[str, object]:
    """A backup of a stage that is larger than the stick, and then of a small one on it."""
    stage = vase(place / "stage")
    noise = stage / "appearances/noise.png"
    noise.write_bytes(os.urandom(600_000))
    log = EventLog(stage / EventLog.FILE, durable=False)
    table = BackupTable(usb="NIGHT BACKUP")
    now = [NIGHT_S]
    nights = NightlyBackup(
        stage, lambda: table, lambda: "UTC", log, busy=lambda: False, wall=lambda: now[0],
        places=lambda stage, table: (Stick(str(table.usb), stage, computer.root),),
    )  # fmt: skip
    nights.step()
    now[0] += 3600
    nights.step()
    failures = [(row.code, row.level, row.text) for row in log.failures]
    left = [path.name for path in computer.stick.iterdir()]
    noise.unlink()
    now[0] += 3600
    nights.step()
    return {"failures": failures, "left": left, "then": [path.name for path in computer.stick.iterdir()]}


def test_a_full_stick_is_one_message_and_gets_the_next_one_that_fits(tmp_path: Path) -> None:
    # root may mount in a namespace of its own also where the system allows no user namespaces
    own = [] if os.geteuid() == 0 else ["--user", "--map-root-user"]
    command = ["unshare", *own, "--mount", sys.executable, "-c", FULL, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    ((code, level, text),) = told["failures"]
    assert (code, level) == ("backup-failed", "error")
    assert "No space left" in text
    assert told["left"] == []
    assert told["then"] == ["velatura-20260504.tar.gz"]
