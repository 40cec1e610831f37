"""A kiosk that is uninstalled, and a blank Debian that becomes the kiosk of a backup."""

from __future__ import annotations

import re
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import numpy.typing as npt

from tests.booted.kiosk import Kiosk
from tests.booted.machine import STAGE, Machine

RESTORED_S = 900.0
"""From a blank Debian with the package to the picture of a backup."""


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


INCOMPLETE = """
mkdir /opt/unpacked
cd /opt/unpacked
tar xzf /opt/velatura-20260504.tar.gz
rm backup-files/cues.csv
tar czf /opt/incomplete.tar.gz velatura-backup.json $(ls | grep -v velatura-backup.json)
"""


def refer_to_other_folders(machine: Machine) -> None:
    """Give the stage files that lie outside of its folder, and that no restored computer has."""
    machine.write(Path("/srv/far.png"), "a picture")
    machine.write(Path("/srv/cues.csv"), "time,verb,values\n")
    machine.write(STAGE / "building.toml", '[cues]\nfile = "/srv/cues.csv"\n')
    with machine.at(STAGE / "stage.toml").open("a") as settings:
        settings.write('\n[[appearances]]\nname = "far"\nkind = "picture"\nfile = "/srv/far.png"\n')


def test_a_blank_machine_becomes_the_kiosk_of_a_backup_after_one_question(playing: Kiosk) -> None:
    machine = playing.machine
    began_s = time.monotonic()
    # What stands outside the computer: the devices, and the stick with the backup.
    machine.call("systemctl", "stop", "bench")
    machine.call(
        "sh", "-c", f"mkdir /opt/devices && cp -a {STAGE}/bench* /opt/devices && mkfifo /opt/answer && touch /opt/told"
    )
    refer_to_other_folders(machine)
    machine.call("/opt/velatura/bin/velatura", "kiosk", "backup", STAGE)
    machine.call("sh", "-c", f"mv $(ls -t {STAGE}/kiosk/archives/backup-* | head -n 1) /opt/velatura-20260504.tar.gz")
    machine.call("sh", "-ec", INCOMPLETE)
    machine.call("/opt/velatura/bin/velatura", "kiosk", "uninstall", "--purge")
    machine.call("rm", "-r", "/srv", "/opt/unpacked")
    assert not machine.at(STAGE).exists()
    assert machine.called("getent", "passwd", "velatura").returncode != 0
    refused = machine.called("/opt/velatura/bin/velatura", "kiosk", "install", "--backup", "/opt/incomplete.tar.gz")
    assert refused.returncode != 0
    assert "The backup is not complete: building.toml names backup-files/cues.csv" in refused.stdout + refused.stderr
    assert machine.called("getent", "passwd", "velatura").returncode != 0, "nothing was done"
    command = "/opt/velatura/bin/velatura kiosk install --backup /opt/velatura-20260504.tar.gz "
    command += "< /opt/answer > /opt/told 2>&1"
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
    assert (machine.at(STAGE) / "backup-files/far.png").read_text() == "a picture"


OTHER = Path("/opt/other")
"""The stage of another computer, which stands beside the machine."""
OTHER_STAGE = """
[stage]
name = "other"
[[projectors]]
name = "P"
output = "P1"
driver = "serial"
host = "{host}"
port = "/dev/ttyUSB0"
profile = "nec"
[[relays]]
name = "cupboard"
driver = "modbus-relays"
host = "{host}"
address = "127.0.0.1:5020"
channels = 3
[[relays.mains]]
channel = 1
feeds = ["P"]
[camera]
driver = "ptp"
iso = 100
address = "ptpip:127.0.0.1"
[display]
driver = "player"
[[display.outputs]]
name = "P1"
width_px = 280
height_px = 210
host = "{host}"
"""
RELAYS = """
import asyncio
from pymodbus.datastore import ModbusDeviceContext, ModbusSequentialDataBlock, ModbusServerContext
from pymodbus.server import StartAsyncTcpServer
coils = ModbusSequentialDataBlock(1, [False] * 9)
board = ModbusServerContext(devices=ModbusDeviceContext(co=coils), single=True)
asyncio.run(StartAsyncTcpServer(board, address=("127.0.0.1", 5020)))
"""
USED = f"""
from pathlib import Path
import numpy as np
from controller.stage.sessions.check import check_stage
from controller.stage.sessions.open import open_device
from hal.deadline import in_seconds
from hal.registry import OpenContext
from plugins.display.player import PlayerDisplay
folder = Path("{OTHER}")
display = PlayerDisplay(folder / "player.sock", None)
display.show({{"P1": np.full((210, 280, 3), (10, 200, 30), np.uint8)}}, deadline=in_seconds(20))
stage = check_stage(folder)
board = open_device(stage.stage.tables.relays[0], *stage.relays[0], OpenContext(folder, runtime=folder), in_seconds(20))
board.switch(1, True, deadline=in_seconds(10))
print([board.state(channel, deadline=in_seconds(10)) for channel in (1, 2)])
"""


def test_a_blank_machine_plays_and_switches_for_a_stage_on_another_computer(bare: Kiosk) -> None:
    machine, python, program = bare.machine, "/opt/velatura/bin/python", "/opt/velatura/bin/velatura"
    machine.call("systemctl", "disable", "--now", "bench")
    machine.call(program, "kiosk", "uninstall", "--purge")
    machine.call(program, "kiosk", "install", "--player")
    told = ("journalctl", "--no-pager", "--output=cat", "--unit=velatura-agent")
    machine.wait_for(lambda: "Code of this computer" in machine.call(*told))
    (code,) = re.findall(r"Code of this computer: (\d{4}-\d{4})", machine.call(*told))
    machine.wait_for(lambda: lit(machine.screen()))
    machine.call("mkdir", OTHER)
    machine.call(program, "kiosk", "agent", "--stage", OTHER, "--admit", "127.0.0.1", "--code", code)
    host = machine.call("hostname").strip().lower()
    machine.write(OTHER / "stage.toml", OTHER_STAGE.format(host=host))
    conductor: list[str | Path] = [
        python,
        "-m",
        "controller.play",
        "--socket",
        OTHER / "player.sock",
        "--keys",
        OTHER / "keys/players",
    ]
    conductor += ["--port", "7449", "--outputs", "P1:280x210", "--host", f"P1={host}", "--allow-unsigned", "--windows"]
    relays = ("systemd-run", "--unit=relays", "--", python, "-c", RELAYS)
    for again in (False, True):
        if again:
            bare.boot()
        machine.wait_for(lambda: machine.called(*relays).returncode == 0)  # once systemd is there
        machine.call("systemd-run", "--unit=conductor", "--setenv=HOME=/tmp", "--", *conductor)
        machine.wait_for(lambda: machine.called(python, "-c", USED).stdout.strip() == "[True, False]")
        screen = machine.screen()
        assert screen is not None
        assert (screen[:210, :280] == (10, 200, 30)).all()
        assert not screen[210:].any()
        assert not screen[:, 280:].any()
    running = machine.call("systemctl", "show", "--value", "--property=NRestarts,User", "velatura-agent").split()
    assert running == ["0", "velatura"]
    assert machine.called("systemctl", "is-active", "--quiet", "velatura-controller").returncode != 0
