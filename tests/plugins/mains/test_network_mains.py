"""Outlets and relays by network against servers by other authors: net-snmp's snmpd, pymodbus's server."""

from __future__ import annotations

import asyncio
import shutil
import socket
import socketserver
import struct
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pymodbus.datastore import ModbusDeviceContext, ModbusSequentialDataBlock, ModbusServerContext
from pymodbus.server import ModbusTcpServer

from controller.stage.rig.lamp_guard import LampGuard
from controller.stage.rig.power import Circuit, close_circuits, open_circuits
from hal.conformance import PowerSwitchConformance
from hal.deadline import Cancelled, in_seconds
from hal.errors import DeviceError, DeviceGone, DeviceRefused, DeviceTimeout
from hal.interfaces import PowerSwitch
from hal.registry import OpenContext
from plugins.emulated.projectors.lamp import LampPhase
from plugins.mains import modbus_relay, snmp_pdu
from tests.controller.stage.rig.lamp_model import Shelf
from tests.waiting import wait_for

SNMPD = shutil.which("snmpd", path="/usr/sbin:/usr/bin")
OUTLETS = 3
SOON = 20.0


def free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


@pytest.fixture(scope="module")
def snmpd(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """net-snmp's agent with the outlets of an APC; its UDP port."""
    if SNMPD is None:
        pytest.skip("snmpd is not installed")
    folder, port = tmp_path_factory.mktemp("snmpd"), free_port(socket.SOCK_DGRAM)
    lines = [f"agentaddress udp:127.0.0.1:{port}", "rwcommunity private 127.0.0.1", "rocommunity public 127.0.0.1"]
    lines += [f"override -rw .{snmp_pdu.PDUS['apc']}.{outlet} integer 2" for outlet in range(1, OUTLETS + 1)]
    (folder / "snmpd.conf").write_text("\n".join(lines) + "\n")
    process = subprocess.Popen(
        [SNMPD, "-f", "-C", "-c", str(folder / "snmpd.conf"), "-Lf", str(folder / "log"), "-p", str(folder / "pid")],
        env={"SNMP_PERSISTENT_DIR": str(folder), "PATH": "/usr/sbin:/usr/bin"},
    )
    wait_for(lambda: f":{port:04X} " in Path("/proc/net/udp").read_text())
    yield port
    process.terminate()
    process.wait(10)


class ModbusServer:
    """pymodbus's server on a thread."""

    def __init__(self) -> None:
        self.port = free_port(socket.SOCK_STREAM)
        self._loop = asyncio.new_event_loop()
        self._server: Any = None
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        wait_for(lambda: f":{self.port:04X} 00000000:0000 0A" in Path("/proc/net/tcp").read_text())

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        self._loop.run_until_complete(self._serve())
        self._loop.close()

    async def _serve(self) -> None:
        coils = ModbusSequentialDataBlock(1, [False] * (OUTLETS + 100))  # type: ignore[no-untyped-call]
        context = ModbusServerContext(devices=ModbusDeviceContext(co=coils), single=True)
        self._server = ModbusTcpServer(context, address=("127.0.0.1", self.port))
        await self._server.serve_forever()

    def close(self) -> None:
        asyncio.run_coroutine_threadsafe(self._server.shutdown(), self._loop).result(10)
        self._thread.join(10)


@pytest.fixture(scope="module")
def modbus() -> Iterator[int]:
    server = ModbusServer()
    yield server.port
    server.close()


class TestSnmpPdu(PowerSwitchConformance):
    @pytest.fixture
    def power_switch(self, snmpd: int, tmp_path: Path) -> Iterator[PowerSwitch]:
        table = {"address": f"127.0.0.1:{snmpd}", "channels": OUTLETS, "version": 2}
        pdu = snmp_pdu.DRIVER.open(table, OpenContext(tmp_path), in_seconds(SOON))
        yield pdu
        pdu.close()


class TestModbusRelays(PowerSwitchConformance):
    @pytest.fixture
    def power_switch(self, modbus: int, tmp_path: Path) -> Iterator[PowerSwitch]:
        table = {"address": f"127.0.0.1:{modbus}", "channels": OUTLETS, "first": 2}
        board = modbus_relay.DRIVER.open(table, OpenContext(tmp_path), in_seconds(SOON))
        yield board
        board.close()


@pytest.mark.parametrize("kind", ["snmp", "modbus"])
def test_a_hot_lamp_keeps_its_mains_and_a_cold_one_loses_them(
    kind: str, request: pytest.FixtureRequest, tmp_path: Path, open_network: Any
) -> None:
    if kind == "snmp":
        table = {"address": f"127.0.0.1:{request.getfixturevalue('snmpd')}", "channels": OUTLETS}
        switch: Any = snmp_pdu.DRIVER.open(table, OpenContext(tmp_path), in_seconds(SOON))
    else:
        table = {"address": f"127.0.0.1:{request.getfixturevalue('modbus')}", "channels": OUTLETS}
        switch = modbus_relay.DRIVER.open(table, OpenContext(tmp_path), in_seconds(SOON))
    projector = open_network(profile="jvc")
    guard = LampGuard("left", projector.driver, Shelf())
    circuit = Circuit("outlet 3", 3, ("left",), 0.0, switch)
    close_circuits([circuit], deadline=in_seconds(SOON))
    assert switch.state(3, deadline=in_seconds(SOON))
    wait_for(lambda: struck(guard))
    with pytest.raises(DeviceRefused) as caught:
        circuit.open({"left": guard}, deadline=in_seconds(SOON))
    assert caught.value.code == "mains-lamp-hot"
    assert switch.state(3, deadline=in_seconds(SOON))
    guard.switch_off(deadline=in_seconds(SOON))
    assert open_circuits([circuit], [guard]) == ()
    assert not switch.state(3, deadline=in_seconds(SOON))
    assert projector.emulator.lamp.phase is LampPhase.STANDBY
    switch.close()


def struck(guard: LampGuard) -> bool:
    """Whether the lamp could be struck: a new one counts as hot for its minimum off time."""
    try:
        guard.switch_on(deadline=in_seconds(SOON))
    except DeviceRefused:
        return False
    return True


def test_an_outlet_that_net_snmp_reads_is_the_one_that_was_switched(snmpd: int, tmp_path: Path) -> None:
    table = {"address": f"127.0.0.1:{snmpd}", "channels": OUTLETS}
    pdu = snmp_pdu.DRIVER.open(table, OpenContext(tmp_path), in_seconds(SOON))
    pdu.switch(2, True, deadline=in_seconds(SOON))
    pdu.close()
    snmpget = shutil.which("snmpget")
    if snmpget is None:
        pytest.skip("net-snmp's snmpget is not installed")
    oid = f"{snmp_pdu.PDUS['apc']}.2"
    arguments = [snmpget, "-v1", "-cpublic", "-Oqv", f"127.0.0.1:{snmpd}", oid]
    assert subprocess.run(arguments, capture_output=True, text=True, check=True).stdout.strip() == "1"


def test_a_community_that_may_not_write_is_told_and_nothing_moves(snmpd: int, tmp_path: Path) -> None:
    table = {"address": f"127.0.0.1:{snmpd}", "channels": OUTLETS, "community": "public", "version": 2}
    pdu = snmp_pdu.DRIVER.open(table, OpenContext(tmp_path), in_seconds(SOON))
    before = pdu.state(1, deadline=in_seconds(SOON))
    with pytest.raises((DeviceRefused, DeviceTimeout)):
        pdu.switch(1, not before, deadline=in_seconds(SOON))
    assert pdu.state(1, deadline=in_seconds(SOON)) is before
    pdu.close()


@pytest.mark.parametrize("open_it", [snmp_pdu.DRIVER.open, modbus_relay.DRIVER.open])
def test_silence_ends_at_the_deadline_and_a_cancelled_call_sooner(open_it: Any, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as mute, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as silent:
        silent.bind(("127.0.0.1", 0))
        one = mute if open_it is modbus_relay.DRIVER.open else silent
        table = {"address": f"127.0.0.1:{one.getsockname()[1]}", "channels": 1}
        started = time.monotonic()
        with pytest.raises((DeviceTimeout, DeviceGone)):
            open_it(table, OpenContext(tmp_path), in_seconds(0.3))
        stop = threading.Event()
        threading.Timer(0.2, stop.set).start()
        with pytest.raises((Cancelled, DeviceGone)):
            open_it(table, OpenContext(tmp_path), in_seconds(SOON, stop))
        assert time.monotonic() - started < 6.0


@pytest.mark.parametrize(
    ("driver", "settings"),
    [
        (snmp_pdu.DRIVER, {"channels": 0}),
        (snmp_pdu.DRIVER, {"channels": 4, "pdu": "none"}),
        (snmp_pdu.DRIVER, {"channels": 4, "column": "apc"}),
        (snmp_pdu.DRIVER, {"channels": 4, "version": 3}),
        (snmp_pdu.DRIVER, {"channels": 4, "on": 2}),
        (modbus_relay.DRIVER, {"channels": 0}),
        (modbus_relay.DRIVER, {"channels": 4, "unit": 300}),
        (modbus_relay.DRIVER, {"channels": 4, "address": "a:b"}),
    ],
)
def test_wrong_settings_are_found_without_a_device(tmp_path: Path, driver: Any, settings: dict[str, Any]) -> None:
    with pytest.raises(DeviceError):
        driver.check({"address": "127.0.0.1", **settings}, OpenContext(tmp_path))


class OddBoard(socketserver.ThreadingTCPServer):
    """A Modbus board of one coil that misbehaves as real ones do.

    ``late_s``: its coil follows so much later; ``closes``: so many connections are closed before an answer;
    ``mute_writes``: so many writes are done, and the connection closed without an answer; ``refusals``: exception codes
    of the next answers.
    """

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), OddLine)
        self.late_s, self.closes, self.mute_writes, self.refusals = 0.0, 0, 0, list[int]()
        self.coil, self.follows_at_s, self.writes = [False, False], 0.0, 0

    def now(self) -> bool:
        return self.coil[time.monotonic() >= self.follows_at_s]


class OddLine(socketserver.BaseRequestHandler):
    server: OddBoard

    def handle(self) -> None:
        board = self.server
        while len(data := self.request.recv(256)) >= 12:
            function, value = data[7], data[10:12] == b"\xff\x00"
            refusal = board.refusals.pop(0) if board.refusals else 0
            if function == 5 and refusal in (0, 5):
                board.coil, board.writes = [board.now(), value], board.writes + 1
                board.follows_at_s = time.monotonic() + board.late_s
            if function == 5 and board.mute_writes:
                board.mute_writes -= 1
                return
            if board.closes:
                board.closes -= 1
                return
            body = data[8:12] if function == 5 else bytes([1, board.now()])
            body = bytes([function | 0x80, refusal]) if refusal else bytes([function]) + body
            self.request.sendall(data[:4] + struct.pack(">HB", len(body) + 1, data[6]) + body)


@pytest.fixture
def odd_board(tmp_path: Path) -> Iterator[tuple[OddBoard, PowerSwitch]]:
    with OddBoard() as board:
        threading.Thread(target=board.serve_forever, args=(0.02,), daemon=True).start()
        table = {"address": f"127.0.0.1:{board.server_address[1]}", "channels": 1}
        switch = modbus_relay.DRIVER.open(table, OpenContext(tmp_path), in_seconds(SOON))
        assert isinstance(switch, PowerSwitch)
        yield board, switch
        switch.close()
        board.shutdown()


@pytest.mark.parametrize(
    "oddity", [{"late_s": 0.5}, {"refusals": [6]}, {"refusals": [0, 5]}, {"refusals": [0, 6, 6]}, {"closes": 1}]
)
def test_a_modbus_board_is_read_back_until_it_has_followed(
    odd_board: tuple[OddBoard, PowerSwitch], oddity: dict[str, Any]
) -> None:
    board, switch = odd_board
    vars(board).update(oddity)
    switch.switch(1, True, deadline=in_seconds(SOON))
    assert switch.state(1, deadline=in_seconds(SOON))
    assert board.writes == 1


def test_a_modbus_command_whose_answer_is_lost_is_sent_once_and_read_back(
    odd_board: tuple[OddBoard, PowerSwitch],
) -> None:
    board, switch = odd_board
    board.mute_writes, board.late_s = 1, 0.3
    switch.switch(1, True, deadline=in_seconds(SOON))
    assert (board.writes, board.now()) == (1, True)


@pytest.mark.parametrize(("code", "words"), [(2, "no coil"), (4, "fault"), (6, "busy"), (11, "behind the gateway")])
def test_a_refusal_of_a_modbus_board_is_told_in_words(
    odd_board: tuple[OddBoard, PowerSwitch], code: int, words: str
) -> None:
    board, switch = odd_board
    board.refusals = [code] * 9
    with pytest.raises(DeviceError, match=words) as caught:
        switch.state(1, deadline=in_seconds(SOON))
    assert caught.value.code == "outlets-refused"
