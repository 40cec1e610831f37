"""The example of CONTRIBUTING.md, "A mains switch in 30 lines", against a device on a socket."""

from __future__ import annotations

import re
import socketserver
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from hal.conformance import PowerSwitchConformance
from hal.deadline import in_seconds
from hal.errors import DeviceGone, DeviceRefused, DeviceTimeout
from hal.interfaces import PowerSwitch
from hal.registry import Driver, OpenContext

PAGE = (Path(__file__).parents[2] / "CONTRIBUTING.md").read_text("utf-8")
SOON = 20.0


def example() -> Driver:
    """The driver that the page makes."""
    section = PAGE.partition("## A mains switch in 30 lines")[2].partition("\n## ")[0]
    (code,) = re.findall(r"```python\n(.*?)```", section, re.DOTALL)
    assert code.count("\n") <= 30
    names: dict[str, Any] = {}
    exec(code, names)
    driver = names["DRIVER"]
    assert isinstance(driver, Driver)
    return driver


class Board(socketserver.ThreadingTCPServer):
    """Two relays on a TCP port; ``stuck``: they do not move; ``mute``: it does not answer."""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Line)
        self.closed, self.stuck = [False, False], False
        self.mute, self.connections = threading.Event(), 0
        self.address = f"127.0.0.1:{self.server_address[1]}"


class Line(socketserver.StreamRequestHandler):
    server: Board

    def handle(self) -> None:
        self.server.connections += 1
        while line := self.rfile.readline().decode():
            if self.server.mute.is_set():
                continue
            word, channel, *value = line.split()
            if word == "SET" and not self.server.stuck:
                self.server.closed[int(channel) - 1] = value == ["1"]
            self.wfile.write(b"%d\n" % self.server.closed[int(channel) - 1])


@pytest.fixture
def board() -> Iterator[Board]:
    with Board() as made:
        thread = threading.Thread(target=made.serve_forever, args=(0.02,))
        thread.start()
        yield made
        made.shutdown()
        thread.join()


@pytest.fixture
def power_switch(board: Board, tmp_path: Path) -> Iterator[PowerSwitch]:
    switch = example().open({"address": board.address, "channels": 2}, OpenContext(tmp_path), in_seconds(SOON))
    yield switch
    switch.close()


class TestExample(PowerSwitchConformance):
    @pytest.fixture
    def power_switch(self, power_switch: PowerSwitch) -> PowerSwitch:
        return power_switch


def test_a_relay_that_does_not_follow_is_told(board: Board, power_switch: PowerSwitch) -> None:
    board.stuck = True
    with pytest.raises(DeviceRefused) as caught:
        power_switch.switch(2, True, deadline=in_seconds(SOON))
    assert caught.value.code == "relay-stuck"


def test_a_device_that_hangs_gets_no_second_call_and_none_moves_it_later(
    board: Board, power_switch: PowerSwitch
) -> None:
    board.mute.set()
    before = board.connections
    for _ in range(2):
        with pytest.raises(DeviceTimeout):
            power_switch.switch(1, True, deadline=in_seconds(0.3))
    assert board.connections == before + 1
    board.mute.clear()
    assert not board.closed[0]


def test_a_device_that_is_not_there_is_gone(tmp_path: Path) -> None:
    with Board() as one:
        address = one.address
    with pytest.raises(DeviceGone) as caught:
        example().open({"address": address, "channels": 2}, OpenContext(tmp_path), in_seconds(SOON))
    assert caught.value.code == "outlets-gone"
