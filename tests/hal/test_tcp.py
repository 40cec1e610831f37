"""Finding a host by its name, which may take longer than anybody waits."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from typing import Any

import pytest

from hal.deadline import Cancelled, Deadline, in_seconds
from hal.errors import DeviceGone, DeviceTimeout
from hal.links import TcpLink
from plugins.ptp.ip import Wire

FIND = socket.getaddrinfo


class NameServer:
    """Answers for the name "projector", once it is asked to; numbers need no name server."""

    def __init__(self) -> None:
        self.answers = threading.Event()
        self.asked = 0

    def getaddrinfo(self, host: str, port: int, *, flags: int = 0, **others: Any) -> Any:
        if host != "projector" or flags & socket.AI_NUMERICHOST:
            return FIND(host, port, flags=flags, **others)
        self.asked += 1
        if not self.answers.wait(60):
            raise socket.gaierror(socket.EAI_AGAIN, "Temporary failure in name resolution")
        return FIND("127.0.0.1", port, **others)


@pytest.fixture
def names(monkeypatch: pytest.MonkeyPatch) -> Iterator[NameServer]:
    server = NameServer()
    monkeypatch.setattr(socket, "getaddrinfo", server.getaddrinfo)
    yield server
    server.answers.set()


@pytest.fixture
def port() -> Iterator[int]:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        yield listener.getsockname()[1]


def test_a_name_server_that_does_not_answer_ends_at_the_deadline_and_is_asked_once(
    names: NameServer, port: int
) -> None:
    for _ in range(3):
        with pytest.raises(DeviceTimeout) as caught:
            TcpLink("projector", port, deadline=in_seconds(0.2))
        assert caught.value.code == "link-no-connection"
    assert names.asked == 1
    names.answers.set()
    TcpLink("projector", port, deadline=in_seconds(60)).close()


def test_waiting_for_a_name_server_can_be_cancelled(names: NameServer, port: int) -> None:
    stop = threading.Event()
    threading.Timer(0.1, stop.set).start()
    with pytest.raises(Cancelled):
        Wire.connect("projector", port, deadline=Deadline(in_seconds(60).at_s, stop))


def test_a_name_is_found_by_the_machines_own_means(port: int) -> None:
    TcpLink("localhost", port, deadline=in_seconds(60)).close()


@pytest.mark.parametrize("host", ["projector..local", "x" * 64, "a\0b", " "])
def test_what_cannot_be_a_name_is_not_there(host: str) -> None:
    with pytest.raises(DeviceGone) as caught:
        TcpLink(host, 4352, deadline=in_seconds(60))
    assert caught.value.code == "link-lost"
    with pytest.raises(DeviceGone) as caught:
        Wire.connect(host, 15740, deadline=in_seconds(60))
    assert caught.value.code == "camera-off"
