"""A kiosk on a bare Debian, without a stage: installed, booted, and the way to its panel shown."""

from __future__ import annotations

import re
import time
from pathlib import Path

import pytest

from tests.booted.kiosk import PICTURE_S, SERVICES, Kiosk
from tests.booted.machine import ADDRESS, STAGE

_HOUSE = """
import sys
from pathlib import Path
from controller.stage.link.membership import Authority, Membership
from controller.stage.link.peers import keep_peer
house = Authority(Path("/tmp/authority"), "City").peers()
own = "/run/velatura/cluster"
for name, place, endpoints in (("house", "/tmp/house", ()), ("knight", own, ("tls/127.0.0.1:7447",))):
    member = Membership(Path(place), name, "City", endpoints)
    keep_peer(member.folder, member, lambda asked: house.certify(asked, name))
"""
_LAST = {"Nice": "19", "CPUSchedulingPolicy": "5", "IOSchedulingClass": "3", "OOMScoreAdjust": "1000"}
"""Behind everything else on the computer: policy 5 and class 3 are those for what is idle."""
_BUSY = "[Service]\nCPUSchedulingPolicy=other\nCPUWeight=\nNice=-5\n"
_LISTENS = """
import sys
from pathlib import Path
from controller.stage.link.peers import peer, scheduler_at
sys.exit(scheduler_at(peer(Path("/run/velatura/cluster"))) is None)
"""
_SOLVED = """
from pathlib import Path
from controller.stage.cluster import connected
from controller.stage.link.peers import peer, scheduler_at, tls_files
def tried(*places):
    import os
    seen = [os.access(place, os.R_OK) for place in places]
    return [os.getuid() > 60000, seen]
import sys, cloudpickle
cloudpickle.register_pickle_by_value(sys.modules["__main__"])
there = peer(Path("/run/velatura/cluster"))
with connected(scheduler_at(there), workers_s=240, tls=tls_files(there)) as cluster:
    private = "/var/lib/velatura/stage", "/run/velatura/player.sock", "/etc/velatura/panel.key"
    print(cluster.submit(tried, *private).result())
"""
EXPOSED_TENTHS = 30
"""Of systemd's measure of what a service could do; 100 is everything."""


def test_the_journal_of_a_first_start_has_no_warning_and_says_what_to_do(bare: Kiosk) -> None:
    read = ("journalctl", "--boot", "--no-pager", "--output=cat", "--unit=velatura*")
    assert bare.machine.call(*read, "--priority=warning") == ""
    # Xorg explains its own marks with the words that are looked for.
    told = bare.machine.call(*read, *(f"--identifier={one}" for one in ("sh", "systemd", "python", "velatura")))
    assert not re.search("(?i)error|warning|fail|does not exist|prepare-only", told)
    assert "There is no stage yet. Set it up in the panel." in told


def test_without_a_stage_the_projectors_show_the_way_to_the_panel(bare: Kiosk) -> None:
    address = bare.read_code()
    assert address == f"https://{ADDRESS}:8377/"
    assert 'name="password"' in bare.machine.fetched(f"{address}login")


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


@pytest.mark.parametrize("service", ["velatura-player", "velatura-controller", "velatura-worker"])
def test_a_service_that_is_broken_into_can_do_little_on_this_debian(bare: Kiosk, service: str) -> None:
    most = f"--threshold={EXPOSED_TENTHS}"
    print(bare.machine.call("systemd-analyze", "security", "--no-pager", most, service).splitlines()[-1])


def test_a_closed_stage_solves_for_its_house_and_what_it_is_sent_sees_nothing_of_it(bare: Kiosk) -> None:
    machine, python = bare.machine, "/opt/velatura/bin/python"
    machine.call("velatura", "kiosk", "install", "--worker")
    shown = machine.call("systemctl", "show", f"--property={','.join(_LAST)}", "velatura-worker").split()
    assert dict(line.split("=") for line in shown) == _LAST
    # On idle processors alone it would never begin here, beside other tests.
    machine.write(Path("/etc/systemd/system/velatura-worker.service.d/busy.conf"), _BUSY)
    machine.call("systemctl", "daemon-reload")
    machine.call("systemctl", "restart", "velatura-worker")
    machine.call(python, "-c", _HOUSE, user="velatura")
    machine.call("systemd-run", "--unit=house", "--uid=velatura", "--setenv=HOME=/tmp", "--",
                 "velatura", "kiosk", "worker", "/tmp/house")  # fmt: skip
    said_again = "while sleep 5; do touch /run/velatura/cluster/closed; done"
    machine.call("systemd-run", "--unit=closed", "--uid=velatura", "--", "sh", "-c", said_again)
    machine.wait_for(lambda: machine.called(python, "-c", _LISTENS, user="velatura").returncode == 0)
    solved = machine.called(python, "-c", _SOLVED, user="velatura")
    told = machine.call("journalctl", "--no-pager", "--output=cat", "--unit=velatura-worker", "--unit=house")
    assert solved.stdout.strip() == "[True, [False, False, False]]", solved.stderr + told
    machine.call("systemctl", "stop", "closed")
    machine.call("rm", "/run/velatura/cluster/closed")
    commands = "cat /proc/[0-9]*/cmdline | tr '\\0' ' '"
    machine.wait_for(lambda: "dask worker" not in machine.call("sh", "-c", commands))
    machine.call("systemctl", "stop", "house")
    machine.call("systemctl", "disable", "--quiet", "--now", "velatura-worker")
    machine.call("rm", "-r", "/etc/systemd/system/velatura-worker.service.d")


def test_a_graphics_processor_could_solve_on_this_debian(bare: Kiosk) -> None:
    """None is plugged in; the program that would use one is there, and looks for it."""
    program = "from controller.optics.solve.engines import graphics_sentence; print(graphics_sentence())"
    said = bare.machine.call("/opt/velatura/bin/python", "-c", program, user="velatura")
    assert said.strip() == "Solves run on the processor: no graphics processor was found."


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
