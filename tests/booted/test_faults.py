"""What happens to a booted kiosk that plays: its disk, its bundle, its clock."""

from __future__ import annotations

import shutil
import time

import pytest

from controller.bundle.install import NAME as COUNT
from controller.core.kiosk_places import RUNTIME
from tests.booted.faults import Disk, clock_of_its_own, disk_of_its_own, spoil
from tests.booted.kiosk import FOURTH, OTHER_SEED, SECOND, SERVICES, THIRD, Kiosk
from tests.booted.machine import ADDRESS, STAGE
from tests.campaigns.power_cuts import kept, lost


def gave_way(playing: Kiosk) -> bool:
    """Whether the bundle before plays, and that is said."""
    return playing.shows() and any("the previous one" in warning for warning in playing.status()["warnings"])


def test_on_a_disk_that_is_read_only_from_the_boot_on_it_plays_and_a_damaged_bundle_gives_way(playing: Kiosk) -> None:
    machine, before = playing.machine, kept(playing)
    playing.install_bundle(SECOND)
    machine.wait_for(lambda: playing.shows(OTHER_SEED))
    number = playing.events()[-1]["number"]
    damaged = playing.bundle
    playing.boot(read_only=True)
    try:
        machine.wait_for(lambda: playing.shows(OTHER_SEED))
        # The devices start again, too.
        machine.wait_for(lambda: set(playing.problems()) == {"disk"} and "disk" in playing.status()["reason"])
        assert "can't be written to" in playing.problems()["disk"]
        assert 'name="password"' in machine.fetched(f"https://{ADDRESS}:8377/login")
        assert {machine.restarts(name) for name in SERVICES} == {0}
        assert playing.shows(OTHER_SEED)
        spoil(damaged)
        machine.call("systemctl", "kill", "--signal=KILL", "velatura-player")
        machine.wait_for(lambda: gave_way(playing))
        assert playing.bundle == damaged, "no link can be changed there"
        machine.call("test", "-s", RUNTIME / COUNT)
    finally:
        playing.boot()
    machine.wait_for(lambda: gave_way(playing) and playing.state == "playing")
    assert playing.bundle != damaged
    assert "bundle-older-plays" in playing.codes(number)
    playing.install_bundle(THIRD)
    machine.wait_for(lambda: not playing.status()["warnings"] and playing.state == "playing")
    assert playing.shows()
    assert lost(playing, before) == []


def told_full(playing: Kiosk, disk: Disk) -> bool:
    """Whether the panel says that the disk is full, where another program takes all that becomes free."""
    disk.fill()
    return "is full" in playing.problems().get("disk", "")


def test_a_full_disk_is_told_once_and_the_picture_stays(playing: Kiosk) -> None:
    machine = playing.machine
    with disk_of_its_own(machine) as disk:
        machine.wait_for(playing.answers)
        machine.wait_for(lambda: playing.state == "playing")
        before, number = kept(playing), playing.events()[-1]["number"]
        with machine.watched() as seen:
            machine.wait_for(lambda: told_full(playing, disk))
            assert set(playing.problems()) == {"disk"}
            disk.clear()
            machine.wait_for(lambda: playing.problems() == {})
        assert len(seen) == 2, "it showed one picture, until the end"
        codes = playing.codes(number)
        # What an earlier test left to remove makes room first.
        assert set(codes[: codes.index("disk-full")]) <= {"disk-filling", "disk-cleared"}
        assert codes[codes.index("disk-full") :] == ["disk-full", "disk-well"]
        disk.fill()
        machine.call("systemctl", "kill", "--kill-whom=main", "--signal=KILL", "velatura-player", "velatura-controller")
        machine.wait_for(playing.shows)
        machine.wait_for(playing.answers)
        machine.wait_for(lambda: told_full(playing, disk) and playing.state == "playing")
        disk.clear()
        machine.wait_for(lambda: playing.problems() == {})
        assert lost(playing, before) == []
        playing.install_bundle(FOURTH)
        machine.wait_for(lambda: playing.shows(OTHER_SEED))
        disk.fill()
        spoil(machine.seen_here(STAGE / "bundles" / playing.bundle.name))
        machine.call("systemctl", "kill", "--signal=KILL", "velatura-player")
        machine.wait_for(lambda: gave_way(playing))
        disk.clear()
        machine.wait_for(lambda: playing.problems() == {})
    machine.wait_for(playing.answers)
    # It was counted in memory, and this is another disk.
    playing.install_bundle(THIRD)
    machine.wait_for(playing.shows)
    machine.wait_for(lambda: playing.state == "playing")


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler (a package of the test set-up)")
def test_hours_are_not_followed_by_a_clock_that_was_lost(playing: Kiosk) -> None:
    machine = playing.machine
    playing.put_hours(around_s=time.time(), without_time="open")
    with clock_of_its_own(machine) as clock:
        machine.wait_for(playing.answers)
        machine.wait_for(lambda: playing.state == "playing")
        number = playing.events()[-1]["number"]
        with machine.watched() as seen:
            clock.lose()
            machine.wait_for(lambda: "clock-unknown" in playing.codes(number))
            machine.call("systemctl", "restart", "velatura-controller")
            machine.wait_for(playing.answers)
            machine.wait_for(lambda: playing.state == "playing")
            clock.find()
            machine.wait_for(lambda: "clock-known" in playing.codes(number))
            assert playing.state == "playing"
        assert len(seen) == 2, "it showed one picture, until the end"
        clocks = [code for code in playing.codes(number) if code.startswith("clock")]
        assert clocks == ["clock-set", "clock-unknown", "clock-unknown", "clock-set", "clock-known"]
        playing.remove_hours()
    machine.wait_for(playing.answers)
    machine.wait_for(lambda: playing.state == "playing")
