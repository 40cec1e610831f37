"""Serial ports on real ptys: who answers, at what rate, and what stands in the way."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from hal.deadline import in_seconds
from hal.finding import Found, Known, SearchScope
from lab.emulated.projectors.boards import BOARDS, baud_of
from plugins.emulated.projectors.lamp import EmulatedLamp, LampPhase, LampTiming
from plugins.emulated.projectors.serial import EmulatedSerialProjector
from plugins.finding import serial_ports
from plugins.finding.access import forbidden
from plugins.projectors.profile_files import load_profile

ROOT = Path(__file__).parents[3]
FAMILIES = [family for family in BOARDS if family != "optoma-ep910" and baud_of(family)]
"""All that can be asked for their power."""


@pytest.fixture
def plugged(tmp_path: Path) -> Iterator[Callable[..., EmulatedSerialProjector]]:
    """Plugs a projector of a family into a port of ``by-id``."""
    made: list[EmulatedSerialProjector] = []

    def plug(family: str = "optoma-later", *, name: str = "usb-adapter", baud: int | None = None) -> Any:
        lamp = EmulatedLamp(LampTiming(0.2, 0.2))
        table = load_profile(family, tmp_path).serial
        assert table is not None
        wire = EmulatedSerialProjector(
            tmp_path / "by-id" / name, lamp, baud=baud or table.baud, board=BOARDS[family](lamp)
        )
        wire.start()
        made.append(wire)
        return wire

    yield plug
    for wire in made:
        wire.stop()


def look(folder: Path, *known: dict[str, Any]) -> list[Found]:
    wanted = SearchScope(
        folder,
        tuple(Known("projector", "serial", table) for table in known),
        serial_ports=folder / "by-id",
        system_ports=False,
        answer_s=0.3,
    )
    return list(serial_ports.find(wanted, in_seconds(60)))


@pytest.fixture
def two_families(monkeypatch: pytest.MonkeyPatch) -> None:
    """A search among two families takes a quarter of the time, where it is not about which family answers."""
    monkeypatch.setattr(serial_ports, "shipped_profiles", lambda: ("benq", "optoma-later"))


def test_every_family_is_told_by_its_answer_and_no_lamp_is_struck(plugged: Any, tmp_path: Path) -> None:
    wires = [plugged(family, name=family) for family in FAMILIES]
    found = {Path(one.address).name: one for one in look(tmp_path)}
    assert set(found) == set(FAMILIES)
    for family, one in found.items():
        assert (one.kind, one.driver, one.problems) == ("projector", "serial", ())
        assert one.settings == {"profile": family, "port": str(tmp_path / "by-id" / family)}
    assert [(wire.lamp.strikes, wire.lamp.phase) for wire in wires] == [(0, LampPhase.STANDBY)] * len(wires)


@pytest.mark.usefixtures("two_families")
def test_a_burning_lamp_burns_on(plugged: Any, tmp_path: Path) -> None:
    wire = plugged()
    wire.lamp.strike()
    look(tmp_path)
    assert wire.lamp.phase in (LampPhase.WARMING, LampPhase.LIT)


@pytest.mark.usefixtures("two_families")
@pytest.mark.parametrize(("written", "real"), [(None, 19200), (57600, 9600)])
def test_a_wrong_rate_is_named_with_the_right_one(plugged: Any, tmp_path: Path, written: int | None, real: int) -> None:
    plugged(baud=real)
    table = {"profile": "optoma-later", "port": "by-id/usb-adapter"} | ({} if written is None else {"baud": written})
    (found,) = look(tmp_path, table)
    assert [problem.code for problem in found.problems] == ["serial-wrong-baud"]
    assert f"baud = {real}" in found.problems[0].remedy
    assert found.settings["baud"] == real


def test_another_family_than_the_stage_says_is_named(plugged: Any, tmp_path: Path) -> None:
    plugged("benq")
    (found,) = look(tmp_path, {"profile": "optoma-later", "port": "by-id/usb-adapter"})
    assert [problem.code for problem in found.problems] == ["serial-other-profile"]
    assert found.settings["profile"] == "benq"


@pytest.mark.usefixtures("two_families")
def test_a_silent_port_is_no_problem_unless_the_stage_names_it(plugged: Any, tmp_path: Path) -> None:
    for name in ("named", "other"):
        plugged(name=name).faults.set(silent=True)
    named, found = look(tmp_path, {"profile": "optoma-later", "port": "by-id/named"})
    assert (found.kind, found.problems) == ("", ())
    assert [problem.code for problem in named.problems] == ["serial-no-answer"]


@pytest.mark.usefixtures("two_families")
def test_what_chatters_and_is_no_projector_is_told_so(tmp_path: Path) -> None:
    master, slave = pty.openpty()
    (tmp_path / "by-id").mkdir()
    (tmp_path / "by-id" / "gps").symlink_to(os.ttyname(slave))
    stop = threading.Event()

    def chatter() -> None:
        while not stop.wait(0.05):
            os.write(master, b"$GPGGA,nonsense*47\r\n")

    thread = threading.Thread(target=chatter)
    thread.start()
    try:
        (found,) = look(tmp_path)
    finally:
        stop.set()
        thread.join()
        os.close(master)
        os.close(slave)
    assert [problem.code for problem in found.problems] == ["serial-garbage"]


def test_a_port_that_is_not_there_is_named(tmp_path: Path) -> None:
    (found,) = look(tmp_path, {"profile": "optoma-later", "port": "by-id/gone"})
    assert [problem.code for problem in found.problems] == ["port-missing"]


def test_the_program_that_holds_a_port_is_named(plugged: Any, tmp_path: Path) -> None:
    wire = plugged()
    code = (
        "import fcntl, serial, sys; s = serial.Serial(sys.argv[1], exclusive=True); print(flush=True); sys.stdin.read()"
    )
    holder = subprocess.Popen(
        [sys.executable, "-c", code, str(wire.path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert holder.stdout is not None
    holder.stdout.readline()
    try:
        (found,) = look(tmp_path)
    finally:
        holder.communicate()
    assert [problem.code for problem in found.problems] == ["port-taken"]
    assert f"({holder.pid})" in found.problems[0].what


def test_a_port_that_this_user_may_not_open_comes_with_its_rule(plugged: Any, tmp_path: Path) -> None:
    wire = plugged()
    Path(wire.path).chmod(0o000)
    if os.geteuid() == 0:
        found = _as_nobody(wire.path)
    else:
        (one,) = look(tmp_path)
        found = [(problem.code, problem.what, problem.remedy) for problem in one.problems]
    ((code, what, remedy),) = found
    assert code == "device-forbidden"
    assert "mode 0000" in what
    assert 'SUBSYSTEM=="tty"' in remedy
    assert "70-velatura-serial.rules" in remedy


def _as_nobody(port: str) -> list[tuple[str, str, str]]:
    """What an ordinary user sees: root may open everything, so another process asks."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.close(read)
            os.setgid(65534)
            os.setuid(65534)
            problem = forbidden(Path(port), "serial port", serial_ports.RULES, "tty")
            assert problem is not None
            os.write(write, "\0".join((problem.code, problem.what, problem.remedy)).encode())
        finally:
            os._exit(0)
    os.close(write)
    with os.fdopen(read, "rb") as pipe:
        told = pipe.read().decode()
    os.waitpid(child, 0)
    code, what, remedy = told.split("\0")
    return [(code, what, remedy)]
