"""Dousers by sACN: judged by the receiver of the library `sacn`, by emulated nodes, and before projectors on wires."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sacn import DataPacket, sACNreceiver

from controller.stage.rig.douser import ProjectorWithDouser
from hal.conformance import DouserConformance
from hal.deadline import in_seconds
from hal.errors import DeviceError, DeviceGone, DeviceRefused, DeviceTimeout, PluginError
from hal.interfaces import Douser
from hal.notices import Notice
from hal.registry import OpenContext, load_drivers, open_device
from hal.values import Power
from lab.emulated.projectors.dousers import EmulatedDouser, EmulatedNode, dmx_nodes, read_levels
from plugins.dousers.sacn_douser import DRIVER, SacnDouser, open_sacn_douser
from plugins.emulated.core.truth import DouserTruth
from plugins.emulated.projectors.lamp import EmulatedLamp, LampPhase, LampTiming
from tests.ports import kept_port
from tests.processes import children, command_of
from tests.waiting import wait_for

SOON = 20.0
CID = bytes(range(16))


def truth(covers: str = "left", channel: int = 3, **others: Any) -> DouserTruth:
    return DouserTruth(**{"port": 0, "universe": 7, "channel": channel, "covers": covers, "travel_s": 0.05, **others})


@contextlib.contextmanager
def node_of(*dousers: DouserTruth, lamps: dict[str, EmulatedLamp]) -> Iterator[tuple[EmulatedNode, list[Any]]]:
    """A node that serves one port, and what it reported."""
    told: list[Any] = []
    (node,) = dmx_nodes(dousers, lamps, lambda *what: told.append(what))
    with node:
        yield node, told


def douser_at(address: str, channel: int = 3, **others: Any) -> SacnDouser:
    table = {"address": address, "universe": 7, "channel": channel, "travel_s": 0.1, **others}
    return open_sacn_douser(table, OpenContext(Path()), in_seconds(SOON))


def burning() -> EmulatedLamp:
    lamp = EmulatedLamp(LampTiming(0.0, 0.1))
    lamp.strike()
    return lamp


class TestSacnDouser(DouserConformance):
    @pytest.fixture
    def douser(self) -> Iterator[Douser]:
        driver = load_drivers().get("douser", "sacn")
        with node_of(truth(), lamps={"left": burning()}) as (node, _):
            table = {"address": node.address, "universe": 7, "channel": 3, "travel_s": 0.1}
            opened: Douser = open_device(driver, table, OpenContext(Path(), checked=False), in_seconds(SOON))
            yield opened
            opened.close()


class Receiver:
    """The receiver of the library `sacn`: what came in a universe, and when its source came and went."""

    def __init__(self, port: int) -> None:
        self.packets: list[DataPacket] = []
        self.presence: list[str] = []
        self._receiver = sACNreceiver(bind_address="127.0.0.1", bind_port=port)
        self._receiver.register_listener("universe", self.packets.append, universe=7)
        self._receiver.register_listener("availability", lambda universe, changed: self.presence.append(changed))
        self._receiver.start()

    def close(self) -> None:
        self._receiver.stop()


@pytest.fixture
def receiver() -> Iterator[tuple[Receiver, str]]:
    with kept_port() as port:
        made = Receiver(port)
        try:
            yield made, f"127.0.0.1:{port}"
        finally:
            made.close()


def test_a_receiver_that_nobody_here_wrote_hears_two_dousers_as_one_source(receiver: tuple[Receiver, str]) -> None:
    heard, address = receiver
    left, right = douser_at(address), douser_at(address, 9, open_level=10, closed_level=200, priority=100)
    left.move(False, deadline=in_seconds(SOON))
    right.move(True, deadline=in_seconds(SOON))
    wait_for(lambda: bool(heard.packets) and heard.packets[-1].dmxData[8] == 200)
    last = heard.packets[-1]
    assert (last.dmxData[2], sum(last.dmxData), last.priority, last.sourceName) == (255, 455, 100, "Velatura")
    assert len({packet.cid for packet in heard.packets}) == 1
    left.close()
    right.move(False, deadline=in_seconds(SOON))
    wait_for(lambda: heard.packets[-1].dmxData[8] == 10)
    # The one that was closed stays as it is, and the stream continues for the other.
    assert (heard.packets[-1].dmxData[2], heard.presence) == (255, ["available"])
    with pytest.raises(DeviceTimeout):  # the blades need longer
        right.move(True, deadline=in_seconds(0.09))
    right.close()
    wait_for(lambda: heard.presence == ["available", "timeout", "timeout", "timeout"])


CONTROLLER = """
import sys, time
from pathlib import Path
from hal.deadline import in_seconds
from hal.registry import OpenContext
from plugins.dousers.sacn_douser import open_sacn_douser
table = {"address": sys.argv[1], "universe": 7, "channel": 3, "travel_s": 0}
douser = open_sacn_douser(table, OpenContext(Path()), in_seconds(20))
douser.move(False, deadline=in_seconds(20))
print("open", flush=True)
time.sleep(60)
"""


def test_the_stream_of_a_controller_that_is_killed_is_ended_at_once(receiver: tuple[Receiver, str]) -> None:
    heard, address = receiver
    process = subprocess.Popen([sys.executable, "-c", CONTROLLER, address], stdout=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdout.readline() == b"open\n"
    wait_for(lambda: bool(heard.packets) and heard.packets[-1].dmxData[2] == 255)
    process.kill()
    process.wait()
    killed_s = time.monotonic()
    wait_for(lambda: "timeout" in heard.presence)
    # By the packets that end a stream: three of them. A lost signal counts as lost after 2.5 s, and once.
    wait_for(lambda: heard.presence.count("timeout") == 3)
    assert time.monotonic() - killed_s < 2.0
    process.stdout.close()


def sender_of(douser: SacnDouser) -> int:
    """The process that sends: a child of this one."""
    return next(pid for pid in children() if "plugins.dousers.sender" in command_of(pid))


@pytest.mark.parametrize("lost", ["close", "hold"])
def test_a_sender_that_is_killed_is_started_again_and_the_node_does_what_it_is_set_to(lost: str) -> None:
    lamp = burning()
    with node_of(truth(lost=lost), lamps={"left": lamp}) as (node, told):
        douser = douser_at(node.address)
        assert lamp.light_level() == 0.0
        douser.move(False, deadline=in_seconds(SOON))
        wait_for(lambda: lamp.light_level() == 1.0)
        os.kill(sender_of(douser), signal.SIGKILL)
        assert douser.closed(deadline=in_seconds(SOON)) is False
        if lost == "hold":
            douser.move(True, deadline=in_seconds(SOON))
            wait_for(lambda: lamp.light_level() == 0.0)
            douser.move(False, deadline=in_seconds(SOON))
            wait_for(lambda: lamp.light_level() == 1.0)
        douser.close()
        if lost == "close":
            wait_for(lambda: lamp.light_level() == 0.0)
            assert told == [("left", True), ("left", False)]
        else:
            # Longer than a tick of the node; whether it held can only be seen by what did not happen.
            time.sleep(0.3)
            assert (lamp.light_level(), [is_open for _, is_open in told]) == (1.0, [True, False, True])


@contextlib.contextmanager
def heard_sources() -> Iterator[tuple[list[int], str]]:
    """The UDP port that each packet came from, in order, and the address to send to."""
    ports: list[int] = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as node:
        node.bind(("127.0.0.1", 0))
        node.settimeout(0.05)
        over = threading.Event()

        def listen() -> None:
            while not over.is_set():
                with contextlib.suppress(TimeoutError):
                    ports.append(node.recvfrom(2048)[1][1])

        thread = threading.Thread(target=listen)
        thread.start()
        try:
            yield ports, f"127.0.0.1:{node.getsockname()[1]}"
        finally:
            over.set()
            thread.join()


def test_a_douser_that_is_closed_during_a_movement_starts_no_second_source() -> None:
    with heard_sources() as (ports, address):
        douser = douser_at(address)
        douser.move(False, deadline=in_seconds(SOON))
        # The movement waits for a process that hangs, and the closing kills that.
        os.kill(sender_of(douser), signal.SIGSTOP)
        moving = threading.Thread(target=moved, args=(douser,))
        moving.start()
        time.sleep(0.3)
        douser.close()
        moving.join(SOON)
        assert not moving.is_alive()
        time.sleep(1.5)
        assert len(set(ports)) == 1


def continued(pid: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGCONT)


def moved(douser: SacnDouser) -> None:
    with contextlib.suppress(DeviceError):
        douser.move(True, deadline=in_seconds(SOON))


def test_a_universe_that_is_opened_again_has_its_second_source_after_its_first() -> None:
    with heard_sources() as (ports, address):
        first = douser_at(address)
        first.move(False, deadline=in_seconds(SOON))
        sender = sender_of(first)
        os.kill(sender, signal.SIGSTOP)
        closing = threading.Thread(target=first.close)
        closing.start()
        time.sleep(0.1)
        threading.Timer(0.55, continued, (sender,)).start()
        second = douser_at(address)
        second.move(True, deadline=in_seconds(SOON))
        closing.join()
        time.sleep(0.5)
        changes = [port for port, before in zip(ports, [0, *ports], strict=False) if port != before]
        assert len(changes) == 2
        second.close()


def test_blades_take_their_time() -> None:
    now = [0.0]
    blades = EmulatedDouser(2.0, clock=lambda: now[0])
    blades.move(True)
    assert blades.passing() == 0.0
    now[0] = 1.0
    assert blades.passing() == 0.5
    blades.move(False)
    now[0] = 2.0
    assert blades.passing() == 0.25
    now[0] = 4.0
    assert blades.passing() == 0.0


def test_a_node_that_does_not_listen_is_named_and_gets_the_level_later() -> None:
    with kept_port() as port:
        douser = douser_at(f"127.0.0.1:{port}")
        assert douser.closed(deadline=in_seconds(SOON)) is None
        with pytest.raises(DeviceGone) as caught:
            douser.move(False, deadline=in_seconds(SOON))
        assert (caught.value.code, str(port) in caught.value.what) == ("douser-gone", True)
        with pytest.raises(DeviceGone):
            douser.closed(deadline=in_seconds(SOON))
        heard = Receiver(port)
        try:
            wait_for(lambda: bool(heard.packets) and heard.packets[-1].dmxData[2] == 255)
            wait_for(lambda: works(douser))
        finally:
            heard.close()
            douser.close()


def works(douser: SacnDouser) -> bool:
    try:
        return douser.closed(deadline=in_seconds(SOON)) is False
    except DeviceGone:
        return False


def test_a_network_that_is_not_there_is_a_device_error() -> None:
    douser = douser_at("multicast", interface="192.0.2.77")
    with pytest.raises(DeviceGone, match="universe 7"):
        douser.move(True, deadline=in_seconds(SOON))
    douser.close()


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"universe": 0}, "universe"), ({"channel": 513}, "channel"), ({"closed_level": 255}, "closed_level"),
        ({"address": "node.example"}, "address"), ({"interface": "eth0"}, "interface"), ({"travel_s": 4}, "travel_s"),
        ({"priority": "high"}, "priority"),
    ],
)  # fmt: skip
def test_wrong_settings_are_found_without_a_device(change: dict[str, Any], named: str) -> None:
    table = {"address": "127.0.0.1", "universe": 7, "channel": 3, **change}
    assert DRIVER.check is not None
    with pytest.raises(PluginError, match=f"'{named}'"):
        DRIVER.check(table, OpenContext(Path()))


class TestBeforeAProjector:
    """The douser follows the lamp of a projector on an emulated serial line."""

    @pytest.fixture
    def doused(self, open_serial: Any) -> Iterator[Any]:
        pair = open_serial()
        lamp = pair.emulator.lamp
        with node_of(truth(), lamps={"left": lamp}) as (node, told):
            made = ProjectorWithDouser("left", pair.driver, lambda deadline: douser_at(node.address))
            yield made, lamp, told
            made.close()

    def test_light_passes_while_the_lamp_is_wanted(self, doused: Any) -> None:
        projector, lamp, told = doused
        assert projector.capabilities.shutter
        assert projector.status(deadline=in_seconds(SOON)).power is Power.OFF
        projector.switch_on(deadline=in_seconds(SOON))
        wait_for(lambda: projector.status(deadline=in_seconds(SOON)).power is Power.ON)
        wait_for(lambda: lamp.light_level() == 1.0)
        projector.set_shutter(True, deadline=in_seconds(SOON))
        wait_for(lambda: lamp.light_level() == 0.0)
        assert projector.status(deadline=in_seconds(SOON)).power is Power.ON
        assert (lamp.phase, lamp.light_level()) == (LampPhase.LIT, 0.0)
        projector.set_shutter(False, deadline=in_seconds(SOON))
        wait_for(lambda: lamp.light_level() == 1.0)
        projector.switch_off(deadline=in_seconds(SOON))
        wait_for(lambda: projector.status(deadline=in_seconds(SOON)).power is Power.OFF)
        wait_for(lambda: told[-1] == ("left", False))
        assert told == [("left", True), ("left", False)] * 2
        assert projector.notices() == []

    def test_one_that_is_lit_when_it_is_opened_keeps_its_light(self, doused: Any) -> None:
        projector, lamp, told = doused
        lamp.warm_now()
        wait_for(lambda: projector.status(deadline=in_seconds(SOON)).power is Power.ON)
        wait_for(lambda: lamp.light_level() == 1.0)
        assert told == [("left", True)]


def test_a_douser_that_fails_strikes_no_lamp_and_keeps_none_lit(open_serial: Any) -> None:
    pair = open_serial()
    lamp = pair.emulator.lamp
    with kept_port() as port:
        projector = ProjectorWithDouser("left", pair.driver, lambda deadline: douser_at(f"127.0.0.1:{port}"))
        with pytest.raises(DeviceGone):
            projector.switch_on(deadline=in_seconds(SOON))
        assert lamp.strikes == 0
        lamp.warm_now()
        for _ in range(2):
            assert projector.status(deadline=in_seconds(SOON)).power is Power.ON
        (notice,) = projector.notices()
        assert (notice.code, "projector left" in notice.what) == ("douser-gone", True)
        projector.switch_off(deadline=in_seconds(SOON))
        wait_for(lambda: lamp.phase in (LampPhase.COOLING, LampPhase.STANDBY))
        projector.close()


def test_a_driver_that_does_not_open_strikes_no_lamp(open_serial: Any) -> None:
    pair = open_serial()

    def refused(deadline: object) -> Douser:
        raise DeviceRefused("made-up", what="It is locked.", remedy="Unlock it.")

    projector = ProjectorWithDouser("left", pair.driver, refused)
    assert projector.status(deadline=in_seconds(SOON)).power is Power.OFF
    assert projector.notices() == [Notice.warning("made-up", "The douser of projector left fails: It is locked.")]
    with pytest.raises(DeviceRefused, match="locked"):
        projector.switch_on(deadline=in_seconds(SOON))
    assert pair.emulator.lamp.strikes == 0


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=700))
def test_any_bytes_are_levels_or_nothing(datagram: bytes) -> None:
    assert read_levels(datagram) is None or len(datagram) > 125


@settings(max_examples=100, deadline=None)
@given(
    universe=st.integers(1, 63999), priority=st.integers(0, 200), sequence=st.integers(0, 255), ended=st.booleans(),
    preview=st.booleans(), code=st.sampled_from([0, 0xDD]), slots=st.binary(max_size=512),
    change=st.none() | st.tuples(st.integers(0, 637), st.integers(1, 255)),
)  # fmt: skip
def test_the_emulated_node_reads_packets_as_the_library_writes_them(
    universe: int, priority: int, sequence: int, ended: bool, preview: bool, code: int, slots: bytes,
    change: tuple[int, int] | None,
) -> None:  # fmt: skip
    packet = DataPacket(tuple(CID), "desk", universe, tuple(slots), priority, sequence, ended, preview,
                        dmxStartCode=code)  # fmt: skip
    made = bytearray(packet.getBytes())
    if change is not None:
        made[change[0]] ^= change[1]
        with contextlib.suppress(DeviceError):
            read_levels(bytes(made))
        return
    read = read_levels(bytes(made))
    if preview or code:
        assert read is None
        return
    assert read is not None
    assert (read.source, read.universe, read.priority, read.sequence) == (CID, universe, priority, sequence)
    assert (read.ended, read.slots) == (ended, slots.ljust(512, b"\0"))


def test_a_bench_refuses_a_douser_before_nothing_and_a_port_in_use() -> None:
    with pytest.raises(DeviceError) as caught:
        next(dmx_nodes([truth("nobody")], {"left": burning()}, lambda *_: None))
    assert caught.value.code == "douser-wrong"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        with pytest.raises(DeviceError) as caught:
            next(dmx_nodes([truth(port=port)], {"left": burning()}, lambda *_: None))
    assert caught.value.code == "port-in-use"


def test_no_thread_and_no_process_is_left() -> None:
    with node_of(truth(), lamps={"left": burning()}) as (node, _):
        before = threading.active_count()
        douser = douser_at(node.address)
        douser.move(True, deadline=in_seconds(SOON))
        pid = sender_of(douser)
        douser.close()
        wait_for(lambda: threading.active_count() == before)
        assert not Path(f"/proc/{pid}").exists()
