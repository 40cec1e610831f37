"""A kiosk from a bare Debian to the picture, and back again after what happens to it: services, X server and disk are
real; the devices are emulated on pseudo-terminals and TCP.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

from controller.bundle.signing import load_signing_key
from controller.bundle.writer import NewAppearance, write_bundle
from tests.booted.machine import ADDRESS, STAGE, Machine
from tests.booted.trees import ROOT, SUITES, tree
from tests.controller.play.wire import Pictures, noise

OUTPUTS = [(name, 280, 210) for name in ("P1", "P2", "P3")]
SERVICES = ("velatura-x11", "velatura-player", "velatura-controller")
PICTURE_S = 60.0
"""From the boot of a bare Debian with the package to a picture."""
pytestmark = pytest.mark.slow


@dataclass(frozen=True)
class Kiosk:
    """An installed one, and what its installation printed."""

    machine: Machine
    told: str

    @property
    def password(self) -> str:
        found = re.search(r"password (\S+) \(once\)", self.told)
        assert found is not None, self.told
        return found[1]

    def shows(self, appearance: Pictures) -> bool:
        """Whether the X server shows this appearance, to the byte, and nothing else."""
        screen = self.machine.screen()
        if screen is None:
            return False
        wanted = np.zeros_like(screen)
        beside = np.concatenate(list(appearance.values()), axis=1)
        wanted[: beside.shape[0], : beside.shape[1]] = beside
        return bool(np.array_equal(screen, wanted))


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Velatura as it is released, built from a copy."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in ("controller", "hal", "plugins", "firmware_configs"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*build, "--wheel-dir", out, source], check=True)
    (found,) = out.glob("*.whl")
    return found


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo's stage for projectors at an X server, with a bundle beside it."""
    out = tmp_path_factory.mktemp("demo") / "out"
    words = ["demo", "--prepare-only", "--out", str(out)]
    subprocess.run([sys.executable, "-m", "controller", *words], check=True, cwd=ROOT, capture_output=True)
    stage = out / "stage"
    described = stage / "stage.toml"
    described.write_text(re.sub(r"^frames = .*\n", "", described.read_text(), flags=re.MULTILINE))
    write_bundle(
        stage / "noise.vel",
        stage="demo small",
        calibration="c",
        created_unix_s=0,
        outputs=OUTPUTS,
        appearances=[NewAppearance(str(seed), noise(OUTPUTS, seed)) for seed in range(2)],
        key=load_signing_key(stage / "keys" / "stage.key"),
    )
    return stage


@pytest.fixture(scope="module", params=SUITES)
def installed(request: pytest.FixtureRequest, wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Kiosk]:
    """A kiosk without a stage, right after its installation."""
    with Machine(tree(request.param), wheel, tmp_path_factory.mktemp(request.param)) as machine:
        machine.switch_on()
        dry = machine.call("/opt/velatura/bin/velatura", "kiosk", "install", "--dry-run")
        assert "useradd" in dry
        assert not machine.at(STAGE).exists()
        yield Kiosk(machine, machine.call("/opt/velatura/bin/velatura", "kiosk", "install"))


@pytest.fixture(scope="module")
def bare(installed: Kiosk) -> Kiosk:
    """As ``installed``; its projectors show the way to the panel."""
    assert installed.machine.wait_for(lambda: read_code(installed.machine) != "") < PICTURE_S
    return installed


@pytest.fixture(scope="module")
def playing(bare: Kiosk, prepared: Path) -> Kiosk:
    """With a stage that plays."""
    machine = bare.machine
    place = machine.at(STAGE)
    described = prepared / "stage.toml"
    shutil.copytree(prepared, place, dirs_exist_ok=True, ignore=shutil.ignore_patterns(described.name))
    machine.call("chown", "--recursive", "velatura:velatura", STAGE)
    machine.call("systemctl", "enable", "--now", "bench")
    machine.wait_for(lambda: os.path.lexists(place / "run" / "tty-left"))
    # As somebody who copies it there: the service finds it by itself.
    shutil.copy(described, place / "new.toml")
    machine.call("chown", "velatura:velatura", STAGE / "new.toml")
    machine.call("mv", STAGE / "new.toml", STAGE / described.name)
    machine.wait_for(lambda: machine.called("velatura", "status", STAGE, user="velatura").returncode == 0)
    machine.call("velatura", "bundle", "install", STAGE / "noise.vel", STAGE, user="velatura")
    machine.wait_for(lambda: machine.called("velatura", "show", STAGE, "1", user="velatura").returncode == 0)
    machine.wait_for(lambda: bare.shows(noise(OUTPUTS, 1)))
    machine.wait_for(lambda: machine.velatura("status")["state"] == "playing")
    return bare


def read_code(machine: Machine) -> str:
    """What a telephone reads from the projectors."""
    screen = machine.screen()
    return "" if screen is None else str(cv2.QRCodeDetector().detectAndDecode(np.ascontiguousarray(screen))[0])


def test_without_a_stage_the_projectors_show_the_way_to_the_panel(bare: Kiosk) -> None:
    address = read_code(bare.machine)
    assert address == f"https://{ADDRESS}:8377/"
    assert 'name="password"' in bare.machine.fetched(f"{address}login")


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


def test_installing_again_changes_nothing(bare: Kiosk) -> None:
    before = [bare.machine.call("systemctl", "show", "--property=MainPID", *SERVICES)]
    again = bare.machine.call("velatura", "kiosk", "install")
    assert not re.search("write|restart|useradd|usermod|openssl|apt-get", again)
    assert [bare.machine.call("systemctl", "show", "--property=MainPID", *SERVICES)] == before


def test_user_and_root_reach_the_running_kiosk(playing: Kiosk) -> None:
    assert playing.machine.velatura("status")["playing"] == "1"
    assert "playing" in playing.machine.call("velatura", "status", STAGE)


@pytest.mark.parametrize("service", SERVICES)
def test_a_killed_service_is_back_with_the_picture_and_nothing_restarts_in_a_loop(playing: Kiosk, service: str) -> None:
    machine, before = playing.machine, {name: playing.machine.restarts(name) for name in SERVICES}
    machine.call("systemctl", "kill", "--signal=KILL", service)
    machine.wait_for(lambda: machine.restarts(service) > before[service])
    machine.wait_for(lambda: playing.shows(noise(OUTPUTS, 1)))
    machine.wait_for(lambda: machine.velatura("status")["state"] == "playing")
    after = {name: machine.restarts(name) - before[name] for name in SERVICES}
    followers = {"velatura-x11": 1} if service == "velatura-x11" else {}
    assert after[service] == 1
    assert sum(after.values()) <= 1 + followers.get(service, 0), after


def test_after_a_restart_of_all_units_the_picture_is_back(playing: Kiosk) -> None:
    playing.machine.call("systemctl", "restart", "velatura.target")
    playing.machine.wait_for(lambda: playing.shows(noise(OUTPUTS, 1)))
    playing.machine.wait_for(lambda: playing.machine.velatura("status")["state"] == "playing")


def test_the_picture_stays_when_the_controller_restarts(playing: Kiosk) -> None:
    machine = playing.machine
    player = machine.call("systemctl", "show", "--property=MainPID", "velatura-player")
    machine.call("systemctl", "kill", "--signal=KILL", "velatura-controller")
    assert playing.shows(noise(OUTPUTS, 1))
    machine.wait_for(lambda: machine.called("velatura", "status", STAGE).returncode == 0)
    assert playing.shows(noise(OUTPUTS, 1))
    assert machine.call("systemctl", "show", "--property=MainPID", "velatura-player") == player


def test_a_backup_is_restored_on_this_debians_python(playing: Kiosk) -> None:
    machine = playing.machine
    restarts = machine.restarts("velatura-controller")
    machine.velatura("backup")
    (backup,) = machine.at(STAGE / "kiosk" / "archives").glob("backup-*")
    machine.call("velatura", "restore", STAGE, STAGE / "kiosk" / "archives" / backup.name, user="velatura")
    machine.wait_for(lambda: machine.called("velatura", "status", STAGE).returncode == 0)
    machine.wait_for(lambda: playing.shows(noise(OUTPUTS, 1)))
    assert machine.restarts("velatura-controller") == restarts, "it begins anew without an end"


def test_after_a_power_cut_the_picture_is_back_by_itself(playing: Kiosk) -> None:
    playing.machine.cut_off()
    playing.machine.switch_on()
    took_s = playing.machine.wait_for(lambda: playing.shows(noise(OUTPUTS, 1)))
    assert took_s < PICTURE_S
    playing.machine.wait_for(lambda: playing.machine.velatura("status")["state"] == "playing")
    assert {playing.machine.restarts(name) for name in SERVICES} == {0}


def test_a_calibration_uses_the_same_player_and_what_it_made_plays(playing: Kiosk) -> None:
    machine = playing.machine
    described = machine.at(STAGE / "stage.toml")
    text = re.sub(r'(driver = "player"\n)', r'\1frames = "run/outputs.frame"\n', described.read_text())
    first, _, _ = text.partition("\n[[appearances]]")
    (machine.at(STAGE) / "new.toml").write_text(f'{first}\n[[appearances]]\nname = "board"\nkind = "checkerboard"\n')
    machine.call("velatura", "settings", STAGE, "--save", STAGE / "new.toml", user="velatura")
    machine.wait_for(lambda: machine.at(STAGE / "run" / "outputs.frame").exists())
    machine.wait_for(lambda: machine.called("velatura", "status", STAGE).returncode == 0)
    player = machine.call("systemctl", "show", "--property=MainPID", "velatura-player")
    machine.call("velatura", "recalibrate", STAGE, user="velatura")
    machine.wait_for(lambda: machine.called("velatura", "show", STAGE, "board", user="velatura").returncode == 0)
    machine.wait_for(lambda: machine.velatura("status")["playing"] == "board")
    assert machine.call("systemctl", "show", "--property=MainPID", "velatura-player") == player
    assert machine.restarts("velatura-controller") == 0


def test_uninstalling_leaves_the_stage_and_nothing_that_starts(playing: Kiosk) -> None:
    machine = playing.machine
    machine.call("velatura", "kiosk", "uninstall")
    left = machine.call("find", "/etc", "/run", "-name", "*velatura*", "-not", "-path", "/etc/velatura*")
    assert [line for line in left.splitlines() if "/run/systemd" not in line] == []
    assert machine.at(STAGE / "stage.toml").exists()
    running = machine.call("sh", "-c", "cat /proc/[0-9]*/cmdline | tr '\\0' ' '")
    assert "emulate" in running
    assert not re.search("serve|controller.play|Xorg :0", running)
