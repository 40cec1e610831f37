"""The PTP/IP link against a camera that says exactly what a test tells it to say."""

from __future__ import annotations

import contextlib
import select
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from hal.deadline import Cancelled, in_seconds
from hal.errors import DeviceBusy, DeviceGone, DeviceRefused, DeviceTimeout, ProtocolError
from lab.emulated.cameras.camera import EmulatedPtpCamera
from plugins.emulated.cameras.body import CameraFaults
from plugins.ptp.ip import PtpIpAddress, PtpIpLink, Wire, readable
from plugins.ptp.link import LinkEvent
from tests.plugins.ptp.ptp_rig import Studio
from tests.waiting import wait_for

OK = 0x2001
ACK = struct.pack("<I", 7) + bytes(16) + "Camera\0".encode("utf-16-le") + struct.pack("<I", 0x10000)


def packet(kind: int, body: bytes = b"") -> bytes:
    return struct.pack("<II", 8 + len(body), kind) + body


def response(transaction: int = 0, code: int = OK, *parameters: int) -> bytes:
    return packet(7, struct.pack(f"<HI{len(parameters)}I", code, transaction, *parameters))


def data_phase(data: bytes, *, transaction: int = 0, announce: int | None = None, kind: int = 12) -> bytes:
    start = packet(9, struct.pack("<IQ", transaction, len(data) if announce is None else announce))
    return start + packet(kind, struct.pack("<I", transaction) + data)


class Scripted:
    """Accepts both connections; then answers every request with the next script, bytes as they are."""

    def __init__(self, *, welcome: bytes = packet(2, ACK), event_welcome: bytes = packet(4)) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._welcome = welcome
        self._event_welcome = event_welcome
        self.answers: list[bytes] = []
        self.heard: list[tuple[int, bytes]] = []
        self.command: socket.socket | None = None
        self.events: socket.socket | None = None
        port = self._listener.getsockname()[1]
        self.address = PtpIpAddress("127.0.0.1", port, port)
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def close(self) -> None:
        for one in (self._listener, self.command, self.events):
            if one is not None:
                with contextlib.suppress(OSError):
                    one.shutdown(socket.SHUT_RDWR)
                one.close()
        self._thread.join(2)

    def _serve(self) -> None:
        try:
            self.command = self._listener.accept()[0]
            self._hear(self.command)
            self.command.sendall(self._welcome)
            self.events = self._listener.accept()[0]
            self._hear(self.events)
            self.events.sendall(self._event_welcome)
            while True:
                self._hear(self.command)
                if self.answers:
                    self.command.sendall(self.answers.pop(0))
        except OSError:
            return

    def _hear(self, connection: socket.socket) -> None:
        length, kind = struct.unpack("<II", self._exactly(connection, 8))
        self.heard.append((kind, self._exactly(connection, length - 8)))

    def _exactly(self, connection: socket.socket, count: int) -> bytes:
        data = b""
        while len(data) < count:
            piece = connection.recv(count - len(data))
            if not piece:
                raise OSError
            data += piece
        return data


Make = Callable[..., Scripted]


@pytest.fixture
def make() -> Iterator[Make]:
    made: list[Scripted] = []

    def one(**options: bytes) -> Scripted:
        made.append(Scripted(**options))
        return made[-1]

    yield one
    for camera in made:
        camera.close()


@pytest.fixture
def camera(make: Make) -> Scripted:
    return make()


@pytest.fixture
def link(camera: Scripted) -> Iterator[PtpIpLink]:
    link = PtpIpLink.connect(camera.address, deadline=in_seconds(20))
    yield link
    link.close()


def test_the_first_request_is_number_zero_and_its_data_and_parameters_come_back(
    camera: Scripted, link: PtpIpLink
) -> None:
    camera.answers.append(data_phase(b"hello") + response(0, OK, 1, 2))
    reply = link.transact(0x1001, 5, deadline=in_seconds(20))
    assert (reply.code, reply.parameters, reply.data) == (OK, (1, 2), b"hello")
    assert camera.heard[-1] == (6, struct.pack("<IHII", 1, 0x1001, 0, 5))


def test_data_may_come_in_many_pieces_and_of_unknown_total(camera: Scripted, link: PtpIpLink) -> None:
    pieces = b"".join(packet(10, struct.pack("<I", 0) + bytes([number])) for number in range(20))
    start = packet(9, struct.pack("<IQ", 0, 0xFFFF_FFFF_FFFF_FFFF))
    camera.answers.append(start + pieces + packet(12, struct.pack("<I", 0)) + response())
    assert link.transact(0x1009, deadline=in_seconds(20)).data == bytes(range(20))


@pytest.mark.parametrize(
    "answer",
    [
        packet(99),
        struct.pack("<II", 0xFFFF_FFFF, 7),
        response(transaction=5),
        data_phase(b"x", transaction=5),
        data_phase(b"short", announce=50) + response(),
        data_phase(b"long", announce=2) + response(),
        data_phase(b"", announce=1 << 40),
        packet(12, struct.pack("<I", 0) + b"unannounced"),
        packet(9, struct.pack("<IQ", 0, 1)) + packet(12, b"\0"),
        packet(2, ACK),
        packet(7, b"\1"),
    ],
)
def test_an_answer_that_breaks_the_protocol_breaks_the_link(camera: Scripted, link: PtpIpLink, answer: bytes) -> None:
    camera.answers.append(answer)
    with pytest.raises(ProtocolError):
        link.transact(0x1001, deadline=in_seconds(20))
    assert link.broken
    with pytest.raises(DeviceGone):
        link.transact(0x1001, deadline=in_seconds(20))


def test_more_data_than_was_asked_for_is_refused_before_it_is_stored(camera: Scripted, link: PtpIpLink) -> None:
    taken: list[bytes] = []
    camera.answers.append(data_phase(bytes(100)) + response())
    with pytest.raises(ProtocolError):
        link.transact(0x101B, sink=lambda piece: taken.append(bytes(piece)), most=10, deadline=in_seconds(20))
    assert not taken


def test_pings_are_answered_on_both_connections(camera: Scripted, link: PtpIpLink) -> None:
    assert camera.events is not None
    camera.events.settimeout(2)
    camera.events.sendall(packet(13))
    camera.answers += [packet(13), response()]
    thread = threading.Thread(target=lambda: link.transact(0x1001, deadline=in_seconds(20)))
    thread.start()
    assert camera.events.recv(100) == packet(14)
    wait_for(lambda: (14, b"") in camera.heard)
    thread.join()


def test_events_are_kept_in_order_however_they_are_cut(camera: Scripted, link: PtpIpLink) -> None:
    assert camera.events is not None
    stream = b"".join(packet(8, struct.pack("<HII", 0x4002, 0, number)) for number in range(3))
    found: list[LinkEvent] = []
    for start in range(0, len(stream), 5):
        camera.events.sendall(stream[start : start + 5])
        time.sleep(0.005)
        found += link.events()
    link.wait_event(0.2, deadline=in_seconds(20))
    found += link.events()
    assert found == [LinkEvent(0x4002, (number,)) for number in range(3)]


def test_waiting_for_an_event_ends_when_it_comes(camera: Scripted, link: PtpIpLink) -> None:
    assert camera.events is not None
    threading.Timer(0.1, camera.events.sendall, [packet(8, struct.pack("<HI", 0x400D, 0))]).start()
    started = time.monotonic()
    link.wait_event(5, deadline=in_seconds(20))
    assert time.monotonic() - started < 10
    assert link.events() == [LinkEvent(0x400D, ())]


@pytest.mark.parametrize("noise", [packet(10, b"\0\0\0\0data"), packet(77), struct.pack("<II", 1 << 30, 8)])
def test_noise_on_the_event_connection_breaks_the_link(camera: Scripted, link: PtpIpLink, noise: bytes) -> None:
    assert camera.events is not None
    camera.events.sendall(noise)
    with pytest.raises(ProtocolError):
        wait_for(link.events)
    assert link.broken


@pytest.mark.parametrize(
    ("reason", "error", "code"),
    [
        (1, DeviceRefused, "camera-refused-pairing"),
        (2, DeviceBusy, "camera-in-use"),
        (3, DeviceRefused, "camera-refused-pairing"),
    ],
)
def test_a_fail_packet_says_why_in_words(make: Make, reason: int, error: type[Exception], code: str) -> None:
    refusal = packet(5, struct.pack("<I", reason))
    for options in ({"welcome": refusal}, {"event_welcome": refusal}):
        with pytest.raises(error) as caught:
            PtpIpLink.connect(make(**options).address, deadline=in_seconds(20))
        assert getattr(caught.value, "code", None) == code


def test_a_camera_that_says_nothing_ends_with_the_deadline_and_one_that_is_cancelled_at_once(
    camera: Scripted, link: PtpIpLink
) -> None:
    started = time.monotonic()
    with pytest.raises(DeviceTimeout):
        link.transact(0x1001, deadline=in_seconds(0.2))
    assert 0.15 < time.monotonic() - started < 10
    assert link.broken
    stop = threading.Event()
    stop.set()
    with pytest.raises(Cancelled):
        PtpIpLink.connect(camera.address, deadline=in_seconds(20, stop))


def test_a_camera_that_never_stops_talking_ends_with_the_deadline(camera: Scripted, link: PtpIpLink) -> None:
    camera.answers.append(packet(8, struct.pack("<HI", 0x4006, 0)) * 400_000)
    started = time.monotonic()
    with pytest.raises(DeviceTimeout):
        link.transact(0x1001, deadline=in_seconds(0.3))
    assert time.monotonic() - started < 10


def test_a_deadline_that_has_passed_leaves_the_link_whole(camera: Scripted, link: PtpIpLink) -> None:
    with pytest.raises(DeviceTimeout):
        link.transact(0x1001, deadline=in_seconds(-1))
    camera.answers.append(response())
    assert link.transact(0x1001, deadline=in_seconds(20)).ok


def test_a_camera_that_hangs_up_is_gone(camera: Scripted, link: PtpIpLink) -> None:
    threading.Timer(0.05, camera.close).start()
    with pytest.raises(DeviceGone) as caught:
        link.transact(0x1001, deadline=in_seconds(20))
    assert caught.value.code == "camera-disconnected"


def _send(wire: Wire) -> None:
    wire.send(bytes(30_000_000), in_seconds(30))


def _receive(wire: Wire) -> None:
    wire.fill(memoryview(bytearray(1)), in_seconds(30), lambda deadline: readable([wire], deadline.left_s()))


@pytest.mark.parametrize("work", [_send, _receive])
def test_a_connection_that_another_thread_closes_is_lost_at_whatever_moment(
    work: Callable[[Wire], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    ours, theirs = socket.socketpair()
    ours.setblocking(False)
    wire = Wire(ours)
    wait = select.select

    def close_and_wait(*arguments: Any) -> Any:
        """Between what a thread knows of a socket and its wait for it, another may run."""
        wire.close()
        return wait(*arguments)

    monkeypatch.setattr(select, "select", close_and_wait)
    with theirs, pytest.raises(DeviceGone):
        work(wire)


def test_an_event_port_that_opens_late_is_waited_for() -> None:
    faults = CameraFaults(late_events_s=0.5)
    with EmulatedPtpCamera(Studio().expose, faults=faults) as camera:
        link = PtpIpLink.connect(PtpIpAddress.parse(camera.address), deadline=in_seconds(20))
        link.close()


def test_an_event_port_that_never_opens_is_named_with_the_camera() -> None:
    faults = CameraFaults(late_events_s=600.0)
    with EmulatedPtpCamera(Studio().expose, faults=faults) as camera:
        address = PtpIpAddress.parse(camera.address)
        with pytest.raises(DeviceRefused) as caught:
            PtpIpLink.connect(address, deadline=in_seconds(20))
        assert caught.value.code == "camera-no-events"
        assert camera.body.names.model in caught.value.what
        assert str(address.event_port) in caught.value.what
