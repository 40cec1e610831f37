"""Byte links over real sockets and real pseudo terminals."""

from __future__ import annotations

import contextlib
import os
import socket
import threading
import time
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest

from hal.deadline import Cancelled, in_seconds
from hal.errors import DeviceBusy, DeviceError, DeviceGone, DeviceTimeout, ProtocolError
from hal.links import TcpLink, host_and_port
from hal.serial_link import SerialLink
from hal.tape import Direction, Tape
from lab.emulated.tape import read_tape


class Peer:
    """The other end of a TCP link."""

    def __init__(self, tape: Path) -> None:
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.tape = Tape(tape)
        port = self.listener.getsockname()[1]
        self.link = TcpLink("127.0.0.1", port, deadline=in_seconds(20), transcript=self.tape.track("tcp", "peer"))
        self.socket, _ = self.listener.accept()

    def close(self) -> None:
        self.link.close()
        self.socket.close()
        self.listener.close()
        self.tape.close()


@pytest.fixture
def peer(tmp_path: Path) -> Iterator[Peer]:
    made = Peer(tmp_path / "peer.tape")
    yield made
    made.close()


def test_lines_are_cut_wherever_the_network_cut_them(peer: Peer) -> None:
    def dribble() -> None:
        for byte in b"one\rtwo\rrest":
            peer.socket.sendall(bytes([byte]))

    sender = threading.Thread(target=dribble)
    sender.start()
    deadline = in_seconds(20)
    assert peer.link.read_until(b"\r", limit=10, deadline=deadline) == b"one\r"
    assert peer.link.read_until(b"\r", limit=10, deadline=deadline) == b"two\r"
    assert peer.link.read_exactly(4, deadline=deadline) == b"rest"
    sender.join()


def test_silence_ends_at_the_deadline_and_keeps_what_came(peer: Peer) -> None:
    peer.socket.sendall(b"half")
    started = time.monotonic()
    with pytest.raises(DeviceTimeout):
        peer.link.read_until(b"\r", limit=10, deadline=in_seconds(0.2))
    assert 0.15 < time.monotonic() - started < 10
    peer.socket.sendall(b" a line\r")
    assert peer.link.read_until(b"\r", limit=20, deadline=in_seconds(20)) == b"half a line\r"


def test_a_cancelled_read_ends_at_once(peer: Peer) -> None:
    stop = threading.Event()
    threading.Timer(0.1, stop.set).start()
    started = time.monotonic()
    with pytest.raises(Cancelled):
        peer.link.read_exactly(1, deadline=in_seconds(20, stop))
    assert time.monotonic() - started < 10


@pytest.fixture
def deaf() -> Iterator[int]:
    """A port at which a call is neither taken nor refused: its queue is full."""
    with contextlib.ExitStack() as opened:
        listener = opened.enter_context(socket.socket())
        listener.bind(("127.0.0.1", 0))
        listener.listen(0)
        for _ in range(4):
            waiting = opened.enter_context(socket.socket())
            waiting.setblocking(False)
            waiting.connect_ex(listener.getsockname())
        yield listener.getsockname()[1]


class SetLater(threading.Event):
    """A cancellation that comes after it was looked at once."""

    def is_set(self) -> bool:
        found = super().is_set()
        self.set()
        return found


def test_a_call_that_nobody_takes_can_be_cancelled(deaf: int) -> None:
    with pytest.raises(Cancelled):
        TcpLink("127.0.0.1", deaf, deadline=in_seconds(5, SetLater()))


def test_one_address_that_nobody_answers_at_leaves_time_for_the_next(
    deaf: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        places = [(socket.AF_INET, socket.SOCK_STREAM, 0, "", ("127.0.0.1", port)) for port in (deaf, deaf)]
        monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: places)
        with pytest.raises(DeviceTimeout) as caught:
            TcpLink("projector", 4352, deadline=in_seconds(0.1))
        assert caught.value.code == "link-no-connection"
        places[1] = (socket.AF_INET, socket.SOCK_STREAM, 0, "", listener.getsockname())
        TcpLink("projector", 4352, deadline=in_seconds(3)).close()


def test_a_line_that_never_ends_is_refused(peer: Peer) -> None:
    peer.socket.sendall(b"x" * 100)
    with pytest.raises(ProtocolError, match="64 bytes"):
        peer.link.read_until(b"\r", limit=64, deadline=in_seconds(20))


def test_drain_takes_what_has_arrived_without_waiting(peer: Peer) -> None:
    assert peer.link.drain() == b""
    peer.socket.sendall(b"stale")
    time.sleep(0.05)
    assert peer.link.drain() == b"stale"
    assert peer.link.drain() == b""


def test_a_closed_connection_is_a_device_gone(peer: Peer) -> None:
    peer.socket.close()
    with pytest.raises(DeviceGone):
        peer.link.read_exactly(1, deadline=in_seconds(20))
    peer.link.close()
    peer.link.close()
    with pytest.raises(DeviceGone):
        peer.link.write(b"x", deadline=in_seconds(20))


def test_a_peer_that_reads_nothing_stops_a_long_write_at_the_deadline(peer: Peer) -> None:
    with pytest.raises(DeviceTimeout):
        peer.link.write(b"x" * 30_000_000, deadline=in_seconds(0.3))


def test_every_byte_stands_on_the_tape(peer: Peer) -> None:
    peer.link.write(b"question\r", deadline=in_seconds(20))
    peer.socket.sendall(b"answer\r")
    peer.link.read_until(b"\r", limit=10, deadline=in_seconds(20))
    (track,) = read_tape(peer.tape.path)
    sent = b"".join(entry.data for entry in track.entries if entry.way is Direction.SENT)
    received = b"".join(entry.data for entry in track.entries if entry.way is Direction.RECEIVED)
    assert (sent, received) == (b"question\r", b"answer\r")


def test_nobody_listening_is_a_device_gone() -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with pytest.raises(DeviceGone, match=str(port)):
        TcpLink("127.0.0.1", port, deadline=in_seconds(20))


@pytest.mark.parametrize(
    ("address", "expected"),
    [("h:1", ("h", 1)), ("h", ("h", 4352)), ("[::1]:80", ("::1", 80)), ("[::1]", ("::1", 4352))],
)
def test_addresses_are_split(address: str, expected: tuple[str, int]) -> None:
    assert host_and_port(address, 4352) == expected


@pytest.mark.parametrize("address", ["", ":1", "h:", "h:0", "h:65536", "h:x", "h:-1"])
def test_addresses_that_are_none_are_refused(address: str) -> None:
    with pytest.raises(DeviceError, match="host:port"):
        host_and_port(address, 4352)


class Pty:
    """A raw pseudo terminal, as a serial port with someone at the other end."""

    def __init__(self) -> None:
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.path = Path(os.ttyname(self.slave))

    def hang_up(self) -> None:
        os.close(self.slave)
        os.close(self.master)
        self.master = -1

    def close(self) -> None:
        if self.master >= 0:
            self.hang_up()


@pytest.fixture
def pty() -> Iterator[Pty]:
    made = Pty()
    yield made
    made.close()


def test_a_serial_port_carries_every_byte_both_ways(pty: Pty) -> None:
    link = SerialLink(pty.path, baud=9600, deadline=in_seconds(20))
    every = bytes(range(256))
    link.write(every, deadline=in_seconds(20))
    assert os.read(pty.master, 1000) == every
    os.write(pty.master, every)
    assert link.read_exactly(256, deadline=in_seconds(20)) == every
    link.close()


def test_a_hang_up_is_a_device_gone_in_every_call(pty: Pty) -> None:
    link = SerialLink(pty.path, baud=9600, deadline=in_seconds(20))
    pty.hang_up()
    with pytest.raises(DeviceGone):
        link.read_exactly(1, deadline=in_seconds(20))
    with pytest.raises(DeviceGone):
        link.write(b"x", deadline=in_seconds(20))
    with pytest.raises(DeviceGone):
        link.drain()
    link.close()
    link.close()
    with pytest.raises(DeviceGone):
        link.read_exactly(1, deadline=in_seconds(20))


def test_a_port_is_held_by_one_program_only(pty: Pty) -> None:
    first = SerialLink(pty.path, baud=9600, deadline=in_seconds(20))
    with pytest.raises(DeviceBusy, match="in use"):
        SerialLink(pty.path, baud=9600, deadline=in_seconds(20))
    first.close()
    SerialLink(pty.path, baud=9600, deadline=in_seconds(20)).close()


def test_a_port_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(DeviceGone, match="tty-nowhere"):
        SerialLink(tmp_path / "tty-nowhere", baud=9600, deadline=in_seconds(20))


@pytest.mark.parametrize(
    ("address", "place"),
    [
        ("host", ("host", 7)),
        ("host:9", ("host", 9)),
        ("192.0.2.1:9", ("192.0.2.1", 9)),
        ("[2001:db8::1]", ("2001:db8::1", 7)),
        ("[2001:db8::1]:9", ("2001:db8::1", 9)),
        ("2001:db8::1", ("2001:db8::1", 7)),
        ("::1", ("::1", 7)),
    ],
)
def test_an_address_is_host_and_port_and_ipv6_stands_in_brackets(address: str, place: tuple[str, int]) -> None:
    assert host_and_port(address, 7) == place


@pytest.mark.parametrize(
    "address",
    [
        "",
        ":9",
        "host:0",
        "host:65536",
        "host:x",
        "[::1",
        "::1]",
        "[]:9",
        "[host]:9",
        "a:b:9",
        "[1.2.3.4]:9",
        "two words:9",
    ],
)
def test_what_is_no_address_is_refused(address: str) -> None:
    with pytest.raises(DeviceError) as caught:
        host_and_port(address, 7)
    assert caught.value.code == "address-wrong"
