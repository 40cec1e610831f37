"""Links to pseudo terminals: one whose owner was killed is removed, and what it leads to is not written to."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from hal.deadline import in_seconds
from hal.errors import DeviceGone
from hal.serial_link import PtyLink, SerialLink, leads_to_its_owner

OWNER = """
import os, sys, time
from pathlib import Path
from hal.serial_link import PtyLink
link = PtyLink(Path(sys.argv[1]), sys.argv[2])
print("made", flush=True)
time.sleep(600)
"""


def test_the_link_of_a_killed_program_is_not_followed(tmp_path: Path) -> None:
    master, slave = os.openpty()
    os.set_blocking(master, False)
    port, path = tmp_path / "run" / "tty-left", os.ttyname(slave)
    command = [sys.executable, "-c", OWNER, str(port), path]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as owner:
        assert owner.stdout is not None
        assert owner.stdout.readline() == "made\n"
        assert leads_to_its_owner(port)
        link = SerialLink(port, baud=9600, deadline=in_seconds(5))
        link.close()
        owner.kill()
        owner.wait(10)
    # The terminal is still there, as it would be if another program had got its number.
    with pytest.raises(DeviceGone) as gone:
        SerialLink(port, baud=9600, deadline=in_seconds(5))
    assert gone.value.code == "port-missing"
    assert list(port.parent.iterdir()) == []
    with pytest.raises(BlockingIOError):
        os.read(master, 1)
    os.close(master)
    os.close(slave)


def test_links_of_others_are_left_alone(tmp_path: Path) -> None:
    master, slave = os.openpty()
    port = tmp_path / "tty"
    port.symlink_to(os.ttyname(slave))
    assert leads_to_its_owner(port)
    assert port.is_symlink()
    (tmp_path / "usb0").symlink_to("/dev/ttyUSB0")
    assert leads_to_its_owner(tmp_path / "usb0")
    assert leads_to_its_owner(tmp_path / "nothing")
    os.close(master)
    os.close(slave)


def test_a_link_that_leads_elsewhere_than_its_owner_said_is_not_followed(tmp_path: Path) -> None:
    link = PtyLink(tmp_path / "tty", "/dev/pts/99991")
    assert leads_to_its_owner(tmp_path / "tty")
    (tmp_path / "tty").unlink()
    (tmp_path / "tty").symlink_to("/dev/pts/99992")
    assert not leads_to_its_owner(tmp_path / "tty")
    link.remove()
    assert list(tmp_path.iterdir()) == []


def test_a_new_owner_takes_the_place_of_a_dead_one(tmp_path: Path) -> None:
    (tmp_path / ".tty.owner").write_text("/dev/pts/1")
    (tmp_path / "tty").symlink_to("/dev/pts/1")
    link = PtyLink(tmp_path / "tty", "/dev/pts/99993")
    assert leads_to_its_owner(tmp_path / "tty")
    link.remove()


def test_a_name_that_no_file_can_have_is_left_to_the_opening(tmp_path: Path) -> None:
    assert leads_to_its_owner(tmp_path / ("p" * 4000))
