"""A kiosk from a bare Debian to the picture, and back again after what happens to it: services, X server and disk are
real; the devices are emulated on pseudo-terminals and TCP.
"""

from __future__ import annotations

import re
import shutil
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from playwright.sync_api import expect

from controller.bundle.format import FIRST_BLOB
from controller.kiosk.install.steps import DEBIAN
from controller.run.time_left import RISE, SLACK_S
from tests.booted.faults import Disk, clock_of_its_own, disk_of_its_own
from tests.booted.kiosk import (
    AGAIN,
    APPEARANCE,
    DAMAGED_LATER,
    OTHER_SEED,
    SERVICES,
    Kiosk,
    installed,
    prepared_stage,
)
from tests.booted.machine import ADDRESS, STAGE
from tests.booted.trees import obstacle
from tests.booted.visitor import check_damaged_settings, check_guessed_tokens, log_in, visiting
from tests.campaigns.power_cuts import cut, cut_now, kept, lost
from tests.controller.panel.browser import CHROMIUM

PICTURE_S = 60.0
"""From the boot of a bare Debian with the package to a picture."""
APPEARANCE_S = 10.0
"""From an X server that listens to the appearance."""
RESTORED_S = 900.0
"""From a blank Debian with the package to the picture of a backup."""
OBSTACLE = obstacle()
pytestmark = [
    pytest.mark.slow, pytest.mark.timeout(1500), pytest.mark.skipif(OBSTACLE is not None, reason=str(OBSTACLE))
]  # fmt: skip


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return prepared_stage(tmp_path_factory.mktemp("demo"))


@pytest.fixture(scope="module", params=DEBIAN)
def bare(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Kiosk]:
    """Installed, without a stage; the projectors show the way to the panel."""
    versions = ("1", "2") if request.param == "bookworm" else ("1",)
    with installed(request.param, tmp_path_factory.mktemp(request.param), versions=versions) as kiosk:
        assert kiosk.machine.wait_for(lambda: kiosk.read_code() != "") < PICTURE_S
        yield kiosk


@pytest.fixture(scope="module")
def playing(bare: Kiosk, stage: Path) -> Kiosk:
    """With a stage that plays."""
    bare.put_stage(stage)
    return bare


def test_without_a_stage_the_projectors_show_the_way_to_the_panel(bare: Kiosk) -> None:
    address = bare.read_code()
    assert address == f"https://{ADDRESS}:8377/"
    assert 'name="password"' in bare.machine.fetched(f"{address}login")


@pytest.mark.parametrize("bare", ["bookworm"], indirect=True)
def test_an_address_that_changes_is_shown_and_reaches_the_panel(bare: Kiosk) -> None:
    machine, other = bare.machine, "198.51.100.7"
    change = "ip address add {}/24 dev net0; ip address del {}/24 dev net0"
    machine.call("sh", "-c", change.format(other, ADDRESS))
    machine.wait_for(lambda: bare.read_code() == f"https://{other}:8377/")
    assert 'name="password"' in machine.fetched(f"https://{other}:8377/login")
    machine.call("sh", "-c", change.format(ADDRESS, other))
    machine.wait_for(lambda: bare.read_code() == f"https://{ADDRESS}:8377/")


def test_the_set_up_page_can_ask_which_projectors_there_are(bare: Kiosk) -> None:
    machine = bare.machine
    process = machine.call("systemctl", "show", "--value", "--property=MainPID", "velatura-controller").strip()
    settings = machine.read(Path(f"/proc/{process}/environ")).decode().split("\0")
    display = [one for one in settings if one.startswith(("DISPLAY=", "XAUTHORITY="))]
    inside = ["nsenter", f"--target={process}", "--mount", "runuser", "-u", "velatura", "--"]
    assert "DUMMY0 connected" in machine.call(*inside, "env", *display, "xrandr")


def test_the_first_password_is_told_once_and_not_in_the_journal(bare: Kiosk) -> None:
    program = (
        "import sys; from pathlib import Path; from controller.kiosk.store.accounts import stage_accounts;"
        "sys.exit(stage_accounts(Path(sys.argv[1])).verify('technician', sys.argv[2]) is None)"
    )
    bare.machine.call("/opt/velatura/bin/python", "-c", program, STAGE, bare.password, user="velatura")
    assert bare.password not in bare.machine.call("journalctl", "--no-pager")
    assert bare.machine.called("test", "-e", "/run/velatura/first-login").returncode == 1


def test_a_dry_run_tells_what_is_done(bare: Kiosk) -> None:
    done = [line for line in bare.told.splitlines() if line.startswith(("write", "useradd", "usermod", "make"))]
    later = ("/etc/X11/xorg.conf.d/20-velatura-outputs.conf", "/var/lib/velatura/player.options")
    assert [line for line in done if not line.endswith(later)] == [
        line for line in bare.dry.splitlines() if line.startswith(("write", "useradd", "usermod", "make"))
    ]


def test_installing_again_changes_nothing(bare: Kiosk) -> None:
    before = [bare.machine.call("systemctl", "show", "--property=MainPID", *SERVICES)]
    again = bare.machine.call("velatura", "kiosk", "install")
    assert not re.search("write|restart|useradd|usermod|openssl|apt-get", again)
    assert [bare.machine.call("systemctl", "show", "--property=MainPID", *SERVICES)] == before


def test_a_boot_without_a_stage_leads_to_the_panel_within_a_minute(bare: Kiosk) -> None:
    began_s = bare.boot()
    bare.machine.wait_for(lambda: bare.read_code() == f"https://{ADDRESS}:8377/")
    took_s = time.monotonic() - began_s
    print(f"{took_s:.1f} s from the boot to the set-up picture")
    assert took_s < PICTURE_S


def test_user_and_root_reach_the_running_kiosk(playing: Kiosk) -> None:
    assert playing.machine.velatura("status")["playing"] == "1"
    assert "playing" in playing.machine.call("velatura", "status", STAGE)


@pytest.mark.parametrize("bare", ["bookworm"], indirect=True)
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
    machine.call("velatura", "restore", STAGE, STAGE / "kiosk" / "archives" / backup.name, user="velatura")
    machine.wait_for(playing.answers)
    machine.wait_for(playing.shows)
    assert machine.restarts("velatura-controller") == restarts, "it begins anew without an end"


@pytest.mark.parametrize("bare", ["trixie"], indirect=True)
def test_after_a_power_cut_the_picture_is_back_by_itself_and_nothing_is_lost(playing: Kiosk) -> None:
    before = kept(playing)
    assert cut(playing, after_s=2.5) < PICTURE_S
    playing.machine.wait_for(lambda: playing.state == "playing")
    assert lost(playing, before) == []
    assert {playing.machine.restarts(name) for name in SERVICES} == {0}


@pytest.mark.parametrize("bare", ["bookworm"], indirect=True)
def test_after_a_power_cut_the_appearance_is_there_soon_after_the_x_server_and_nothing_is_lost(playing: Kiosk) -> None:
    before = kept(playing)
    took_s = playing.boot_beside_devices()
    print(f"{took_s:.1f} s from X to the appearance")
    assert took_s <= APPEARANCE_S
    playing.machine.wait_for(lambda: playing.state == "playing")
    assert lost(playing, before) == []
    assert {playing.machine.restarts(name) for name in SERVICES} == {0}


def test_a_disk_that_is_read_only_from_the_boot_on_is_told_and_the_picture_is_there(playing: Kiosk) -> None:
    machine, before = playing.machine, kept(playing)
    playing.boot(read_only=True)
    try:
        machine.wait_for(playing.shows)
        # The devices begin anew, too.
        machine.wait_for(lambda: set(playing.problems()) == {"disk"} and "disk" in playing.status()["reason"])
        assert "can't be written to" in playing.problems()["disk"]
        assert 'name="password"' in machine.fetched(f"https://{ADDRESS}:8377/login")
        assert {machine.restarts(name) for name in SERVICES} == {0}
        assert playing.shows()
    finally:
        playing.boot()
    machine.wait_for(playing.shows)
    machine.wait_for(lambda: playing.state == "playing")
    assert lost(playing, before) == []


@pytest.mark.parametrize("bare", ["trixie"], indirect=True)
def test_a_bundle_that_was_damaged_gives_way_to_the_one_before_and_that_is_said(playing: Kiosk) -> None:
    machine, number = playing.machine, playing.events()[-1]["number"]
    damaged = playing.install_bundle(DAMAGED_LATER)
    machine.wait_for(lambda: playing.shows(OTHER_SEED))
    data = bytearray(damaged.read_bytes())
    data[FIRST_BLOB : len(data) * 8 // 10] = np.random.default_rng(3).bytes(len(data) * 8 // 10 - FIRST_BLOB)
    damaged.chmod(0o600)
    damaged.write_bytes(data)
    machine.call("systemctl", "kill", "--signal=KILL", "velatura-player")
    machine.wait_for(playing.shows)
    machine.wait_for(lambda: any("the previous one" in warning for warning in playing.status()["warnings"]))
    assert "bundle-older-plays" in playing.codes(number)
    playing.install_bundle(AGAIN)
    machine.wait_for(lambda: not playing.status()["warnings"] and playing.state == "playing")
    assert playing.shows()


def told_full(playing: Kiosk, disk: Disk) -> bool:
    """Whether the panel says that the disk is full, where another program takes all that becomes free."""
    disk.fill()
    return "is full" in playing.problems().get("disk", "")


@pytest.mark.parametrize("bare", ["bookworm"], indirect=True)
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
    machine.wait_for(playing.shows)
    machine.wait_for(playing.answers)
    machine.wait_for(lambda: playing.state == "playing")


@pytest.mark.parametrize("bare", ["bookworm"], indirect=True)
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


@pytest.mark.parametrize("bare", ["bookworm"], indirect=True)
def test_another_version_is_installed_while_it_plays_and_taken_back(playing: Kiosk) -> None:
    machine = playing.machine
    version = ("dpkg-query", "--show", "--showformat=${Version}", "velatura")
    first, second = playing.packages
    before = kept(playing)
    for package, wanted in ((second, "2-1~deb"), (first, "1-1~deb")):
        with machine.watched() as seen:
            machine.install(package)
            assert machine.call(*version).startswith(wanted)
            machine.wait_for(playing.shows)
            machine.wait_for(lambda: playing.state == "playing")
        shown = [what for _, what in seen[:-1]]
        assert shown == [shown[0], "black", shown[0]], "it was black once, and never showed anything else"
        print(f"black for {seen[2][0] - seen[1][0]:.2f} s")
        assert lost(playing, before) == []
        assert {machine.restarts(name) for name in SERVICES[1:]} == {0}


@pytest.mark.parametrize("bare", ["bookworm"], indirect=True)
def test_a_calibration_uses_the_same_player_and_what_it_made_plays(playing: Kiosk) -> None:
    machine = playing.machine
    playing.let_the_camera_see()
    player = machine.call("systemctl", "show", "--property=MainPID", "velatura-player")
    shown: list[tuple[float, str]] = []

    def note(job: dict[str, Any]) -> None:
        if not job.get("ended", True) and job["left_s"] is not None and job["name"] == "Full recalibration":
            shown.append((job["left_s"], job["why"]))

    playing.calibrate(note)
    assert len(shown) > 10
    least_s = float("inf")
    for left_s, why in shown:
        assert left_s <= RISE * least_s + SLACK_S or why, "the time left rose, and nobody said why"
        least_s = min(least_s, left_s)
    assert playing.shows_installed()
    assert machine.call("systemctl", "show", "--property=MainPID", "velatura-player") == player
    assert machine.restarts("velatura-controller") == 0


def works(playing: Kiosk, name: str) -> bool:
    job = playing.status()["job"] or {}
    return str(job.get("name", "")).startswith(name) and bool(job["steps"]) and not job["ended"]


@pytest.mark.parametrize("bare", ["bookworm"], indirect=True)
def test_power_cuts_while_it_calibrates_and_publishes_leave_the_picture_and_are_told(playing: Kiosk) -> None:
    machine = playing.machine
    calibrated = len(list(machine.at(STAGE / "runs").iterdir()))
    machine.wait_for(lambda: playing.state == "playing" and not playing.problems())
    playing.begin("recalibrate")
    machine.wait_for(lambda: works(playing, "Full recalibration"))
    before, number = kept(playing), playing.events()[-1]["number"]
    assert cut_now(playing, playing.shows_installed) < PICTURE_S
    assert lost(playing, before) == []
    machine.wait_for(lambda: "work-cut-off" in playing.codes(number))
    assert len(list(machine.at(STAGE / "runs").iterdir())) == calibrated + 1, "the calibration can continue"
    machine.wait_for(playing.answers)
    playing.begin_appearance("random", 1)
    machine.wait_for(lambda: works(playing, "New appearance random"))
    before, number = kept(playing), playing.events()[-1]["number"]
    assert cut_now(playing, playing.shows_installed) < PICTURE_S
    assert lost(playing, before) == []
    machine.wait_for(lambda: {"work-cut-off", "published"} <= set(playing.codes(number)))
    shown = machine.call("velatura", "appearances", STAGE, user="velatura")
    assert "random" in shown, "what needs no lamps is done again by itself"


def test_uninstalling_leaves_the_stage_and_nothing_that_starts(playing: Kiosk) -> None:
    machine = playing.machine
    machine.call("velatura", "kiosk", "uninstall")
    left = machine.call("find", "/etc", "/run", "-name", "*velatura*", "-not", "-path", "/etc/velatura*")
    assert [line for line in left.splitlines() if "/run/systemd" not in line] == []
    assert machine.at(STAGE / "stage.toml").exists()
    running = machine.call("sh", "-c", "cat /proc/[0-9]*/cmdline | tr '\\0' ' '")
    assert "emulate" in running
    assert not re.search("serve|controller.play|Xorg :0", running)


def lit(screen: npt.NDArray[np.uint8] | None) -> bool:
    return screen is not None and bool(screen.any())


def test_a_blank_machine_becomes_the_kiosk_of_a_backup_after_one_question(playing: Kiosk) -> None:
    machine = playing.machine
    began_s = time.monotonic()
    # What stands outside the computer: the devices, and the stick with the backup.
    machine.call("systemctl", "stop", "bench")
    machine.call(
        "sh", "-c", f"mkdir /opt/devices && cp -a {STAGE}/bench* /opt/devices && mkfifo /opt/answer && touch /opt/told"
    )
    machine.call("/opt/velatura/bin/velatura", "backup", STAGE)
    machine.call("sh", "-c", f"mv $(ls -t {STAGE}/kiosk/archives/backup-* | head -n 1) /opt/velatura-20260504.tar.gz")
    machine.call("/opt/velatura/bin/velatura", "kiosk", "uninstall", "--purge")
    assert not machine.at(STAGE).exists()
    assert machine.called("getent", "passwd", "velatura").returncode != 0
    command = "/opt/velatura/bin/velatura kiosk restore /opt/velatura-20260504.tar.gz < /opt/answer > /opt/told 2>&1"
    with ThreadPoolExecutor(1) as pool:
        restoring = pool.submit(machine.called, "sh", "-c", command)
        # The pipe has to be open at both ends before the command starts.
        machine.call("sh", "-c", "sleep infinity > /opt/answer 2> /dev/null < /dev/null & echo $! > /opt/holder")
        try:
            machine.wait_for(lambda: b"Type those of" in machine.read(Path("/opt/told")) or restoring.done())
            screen = machine.screen()
            code = playing.read_code()
        finally:  # or the command waits for an answer, and the test for the command
            machine.call("sh", "-c", "echo '- - -' > /opt/answer; kill $(cat /opt/holder)")
        done = restoring.result()
    told = machine.read(Path("/opt/told")).decode()
    assert done.returncode == 0, told
    assert told.count("Type those of") == 1
    assert lit(screen)
    assert code == "", "the projectors show numbers, not the way to the panel"
    machine.call("sh", "-c", f"cp -a /opt/devices/bench* {STAGE}; chown -R velatura:velatura {STAGE}/bench*")
    machine.call("systemctl", "restart", "bench")
    machine.wait_for(playing.answers)
    machine.wait_for(lambda: playing.status()["playing"] in ("1", "board"))
    if playing.status()["playing"] == "1":
        machine.wait_for(playing.shows)
    # where this Debian was calibrated, `board` plays into the file that the bench's camera sees, not on X
    assert time.monotonic() - began_s < RESTORED_S
