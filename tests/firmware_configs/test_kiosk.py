"""The systemd units and X11 settings that we ship: systemd and Xorg understand them, and so does what they start."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

from controller.core.kiosk_places import PLAYER_OPTIONS, PLAYER_SOCKET, STAGE
from controller.play.__main__ import parser
from controller.play.control.launch import PlayerSettings, start_player
from tests.controller.play.display.xorg import HEIGHT, WIDTH, running_server
from tests.controller.play.wire import Wire

CONFIGS = Path(__file__).parents[2] / "firmware_configs"
UNITS = CONFIGS / "systemd"
MOST_EXPOSED = {"velatura-player": 15, "velatura-controller": 20, "velatura-x11": 70}
"""Tenths of systemd's measure of what a broken-into service could do; 100 is everything. X drives the hardware."""
needs_systemd = pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")


@pytest.fixture
def units(tmp_path: Path) -> Path:
    """The units as on a kiosk whose programs are there."""
    for path in UNITS.iterdir():
        text = re.sub(r"/opt/velatura/bin/\S+|/usr/lib/xorg/Xorg", "/bin/true", path.read_text())
        (tmp_path / path.name).write_text(text)
    return tmp_path


@needs_systemd
def test_systemd_understands_every_line(units: Path) -> None:
    files = [str(path) for path in sorted(units.iterdir())]
    told = subprocess.run(["systemd-analyze", "verify", *files], capture_output=True, text=True, check=False)
    assert (told.returncode, told.stderr) == (0, "")


@needs_systemd
@pytest.mark.parametrize(("unit", "most"), MOST_EXPOSED.items())
def test_services_can_do_little_else(units: Path, unit: str, most: int) -> None:
    command = ["systemd-analyze", "security", "--offline=true", "--no-pager", f"--threshold={most}"]
    told = subprocess.run([*command, str(units / f"{unit}.service")], capture_output=True, text=True, check=False)
    assert told.returncode == 0, told.stdout[-200:]


def setting(unit: str, key: str) -> str:
    found = re.search(rf"^{key}=(.*)$", (UNITS / unit).read_text(), re.MULTILINE)
    assert found is not None
    return found[1]


def test_the_players_command_is_one_that_it_understands(tmp_path: Path) -> None:
    wanted = PlayerSettings([("P1", 1400, 1050)], None, where={"P1": "HDMI-1"}, trusted=[Path("/k.pub")])
    options = tmp_path / "options"
    options.write_text("".join(f"{word}\n" for word in wanted.arguments()))
    text = setting("velatura-player.service", "ExecStart")
    program, *arguments = shlex.split(text.replace(f"@{PLAYER_OPTIONS}", f"@{options}"))
    assert (program, *arguments[:2]) == ("/opt/velatura/bin/python", "-m", "controller.play")
    read = parser().parse_args(arguments[2:])
    assert read.windows
    assert read.resume
    assert (read.outputs, read.where, read.trusted) == ("P1:1400x1050", ["P1=HDMI-1"], [Path("/k.pub")])
    assert read.socket == PLAYER_SOCKET


def test_the_controllers_command_serves_the_stage_and_says_when_it_is_ready() -> None:
    words = shlex.split(setting("velatura-controller.service", "ExecStart"))
    assert words == ["/opt/velatura/bin/velatura", "kiosk", "serve", str(STAGE), "--setup", "$OPTIONS"]
    assert setting("velatura-controller.service", "Type") == "notify"


def test_a_hung_player_is_replaced_within_five_seconds() -> None:
    watchdog, pause = (int(setting("velatura-player.service", key)) for key in ("WatchdogSec", "RestartSec"))
    assert watchdog + pause + 0.7 < 5, "0.7 s is what the player needs to its first picture"


def test_an_x_server_with_our_settings_starts_and_the_player_on_it(tmp_path: Path) -> None:
    settings = tmp_path / "conf.d"
    settings.mkdir()
    shutil.copy(CONFIGS / "x11" / "10-velatura.conf", settings)
    with running_server(tmp_path, settings_folder=settings) as outputs:
        log = (tmp_path / "log").read_text()
        everywhere, _, _ = (settings / "10-velatura.conf").read_text().partition("OutputClass")
        for option in re.findall(r'Option ("\w+" "\w+")', everywhere):
            assert f"(**) Option {option}" in log or "Disable" in option
        chosen = PlayerSettings([("P1", WIDTH, HEIGHT)], None, where={"P1": "DUMMY1"})
        with start_player(tmp_path, chosen) as player, Wire(player.socket) as wire:
            assert wire.ask("identify")["ok"]
            assert outputs.picture(WIDTH)[0].all()
