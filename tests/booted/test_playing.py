"""A booted kiosk that plays: reached by people, killed, restarted, and cut off."""

from __future__ import annotations

from pathlib import Path

import pytest
from playwright.sync_api import expect

from tests.booted.kiosk import APPEARANCE, PICTURE_S, SERVICES, Kiosk
from tests.booted.machine import STAGE
from tests.booted.visitor import check_damaged_settings, check_guessed_tokens, log_in, visiting
from tests.campaigns.power_cuts import cut, kept, lost
from tests.controller.panel.browser import CHROMIUM

APPEARANCE_S = 10.0
"""From an X server that listens to the appearance."""


def test_user_and_root_reach_the_running_kiosk(playing: Kiosk) -> None:
    assert playing.machine.velatura("status")["playing"] == "1"
    assert "playing" in playing.machine.call("velatura", "kiosk", "status", STAGE)


@pytest.mark.skipif(not CHROMIUM.exists(), reason="needs Debian's chromium (a package of the test set-up)")
def test_a_browser_on_another_computer_logs_in_and_sees_what_happens(playing: Kiosk, tmp_path: Path) -> None:
    machine, number = playing.machine, playing.events()[-1]["number"]
    with visiting(machine, tmp_path) as page:
        log_in(page, "a wrong password")
        first = playing.password
        log_in(page, first)
        page.wait_for_url("**/password")
        for label in ("New password, 10 characters or more", "New password again"):
            page.get_by_label(label).fill("seven tall horses")
        page.get_by_role("button", name="Change").click()
        page.wait_for_url("**/")
        expect(page.locator("p.state")).to_contain_text(f"Playing {APPEARANCE}")
        expect(page.locator("#live-devices")).to_contain_text("left")
        said = [row["text"] for row in playing.events() if row["number"] > number]
        assert "A log-in as technician from 192.0.2.8 was refused." in said
        assert "technician logged in from 192.0.2.8." in said
        page.get_by_role("button", name="Close", exact=True).click()
        expect(page.get_by_text("Close the stage?")).to_be_visible()
        assert playing.shows()
        check_damaged_settings(playing, page)
        check_guessed_tokens(playing, page)


@pytest.mark.parametrize("service", SERVICES)
def test_a_killed_service_is_back_with_the_picture_and_nothing_restarts_in_a_loop(playing: Kiosk, service: str) -> None:
    machine, before = playing.machine, {name: playing.machine.restarts(name) for name in SERVICES}
    machine.call("systemctl", "kill", "--signal=KILL", service)
    machine.wait_for(lambda: machine.restarts(service) > before[service])
    machine.wait_for(playing.shows)
    machine.wait_for(lambda: playing.state == "playing")
    after = {name: machine.restarts(name) - before[name] for name in SERVICES}
    followers = {"velatura-x11": 1} if service == "velatura-x11" else {}
    assert after[service] == 1
    assert sum(after.values()) <= 1 + followers.get(service, 0), after


def test_after_a_restart_of_all_units_the_picture_is_back(playing: Kiosk) -> None:
    playing.machine.call("systemctl", "restart", "velatura.target")
    playing.machine.wait_for(playing.shows)
    playing.machine.wait_for(lambda: playing.state == "playing")


def test_the_picture_stays_when_the_controller_restarts(playing: Kiosk) -> None:
    machine = playing.machine
    player = machine.call("systemctl", "show", "--property=MainPID", "velatura-player")
    machine.call("systemctl", "kill", "--signal=KILL", "velatura-controller")
    assert playing.shows()
    machine.wait_for(playing.answers)
    assert playing.shows()
    assert machine.call("systemctl", "show", "--property=MainPID", "velatura-player") == player


def test_a_backup_is_restored_on_this_debians_python(playing: Kiosk) -> None:
    machine = playing.machine
    restarts = machine.restarts("velatura-controller")
    machine.velatura("backup")
    (backup,) = machine.at(STAGE / "kiosk" / "archives").glob("backup-*")
    machine.call("velatura", "kiosk", "restore", STAGE, STAGE / "kiosk" / "archives" / backup.name, user="velatura")
    machine.wait_for(playing.answers)
    machine.wait_for(playing.shows)
    assert machine.restarts("velatura-controller") == restarts, "it begins anew without an end"


def test_after_a_power_cut_the_picture_is_back_by_itself_and_nothing_is_lost(playing: Kiosk) -> None:
    before = kept(playing)
    assert cut(playing, after_s=2.5) < PICTURE_S
    playing.machine.wait_for(lambda: playing.state == "playing")
    assert lost(playing, before) == []
    assert {playing.machine.restarts(name) for name in SERVICES} == {0}


def test_after_a_power_cut_the_appearance_is_there_soon_after_the_x_server_and_nothing_is_lost(playing: Kiosk) -> None:
    before = kept(playing)
    took_s = playing.boot_beside_devices()
    print(f"{took_s:.1f} s from X to the appearance")
    assert took_s <= APPEARANCE_S
    playing.machine.wait_for(lambda: playing.state == "playing")
    assert lost(playing, before) == []
    assert {playing.machine.restarts(name) for name in SERVICES} == {0}
