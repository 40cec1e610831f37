"""Runs on the machine with the real kernel: the driver ``gpio-keys`` on chips of the kernel's own drivers.

The USB adapters on their bus are emulated (``gpio_adapters``).
"""

from __future__ import annotations

import contextlib
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from hal.conformance import ButtonPanelConformance
from hal.deadline import in_seconds
from hal.errors import DeviceError, DeviceGone, DeviceRefused
from hal.registry import OpenContext
from hal.values import TECHNICIAN_KEYS
from plugins.gpio.keys import GpioKeys, open_keys
from tests.real_kernel.gpio_adapters import Cp2112, Mcp2221
from tests.real_kernel.usb_ip import Cable

Board = tuple[Cp2112 | Mcp2221, list[Cable]]
"""An adapter, and the cable by which it is plugged in now."""
PATIENCE_S = 60.0
LABELS: dict[type[Cp2112 | Mcp2221], str] = {Cp2112: "cp2112_gpio", Mcp2221: "mcp2221_gpio"}
PLAY, STOP, RECALIBRATE = (TECHNICIAN_KEYS.index(name) for name in ("play", "stop", "recalibrate"))
ENOUGH_LOOKS = 15


def opened(label: str, **settings: object) -> GpioKeys:
    keys = [{"line": 0, "does": "play"}, {"line": 1, "does": "stop", "active_low": False},
            {"line": 2, "does": "recalibrate"}]  # fmt: skip
    return open_keys({"chip": label, "keys": keys, **settings}, OpenContext(Path()), in_seconds(PATIENCE_S))


@pytest.fixture(scope="module")
def boards() -> Iterator[dict[type, Board]]:
    """All of them from the beginning.

    The second line has a resistor to ground, the others to the supply.
    """
    made: dict[type, Board] = {}
    for port, kind in enumerate(LABELS):
        adapter = kind()
        adapter.levels[1] = False
        made[kind] = adapter, [Cable(adapter, port)]
    yield made
    for _, cables in made.values():
        cables[-1].pull()


@pytest.fixture(scope="module", params=LABELS, ids=lambda kind: kind.__name__)
def board(request: pytest.FixtureRequest, boards: dict[type, Board]) -> Board:
    return boards[request.param]


def when_there(board: Board) -> GpioKeys:
    ends = in_seconds(PATIENCE_S)
    while True:
        try:
            return opened(LABELS[type(board[0])])
        except DeviceGone:
            assert not ends.passed
            time.sleep(0.2)


@pytest.fixture(scope="module")
def keys(board: Board) -> Iterator[GpioKeys]:
    panel = when_there(board)
    # a key that is down when its line is first read was not pressed since
    looked(board[0])
    yield panel
    panel.close()


def looked(adapter: Cp2112 | Mcp2221) -> None:
    """Wait until the lines were read several times."""
    ends, until = in_seconds(PATIENCE_S), adapter.looks + ENOUGH_LOOKS
    while adapter.looks < until:
        assert not ends.passed
        time.sleep(0.01)


def press(adapter: Cp2112 | Mcp2221, line: int) -> None:
    """Press a key and let it go, each for so long that its line is read several times."""
    for _ in range(2):
        adapter.levels[line] = not adapter.levels[line]
        looked(adapter)


@pytest.fixture(scope="class")
def button_panel(board: Board) -> Iterator[GpioKeys]:
    panel = when_there(board)
    yield panel
    panel.close()


class TestGpioKeys(ButtonPanelConformance):
    patience_s = PATIENCE_S
    prompt_s = 10.0

    def test_refuses_what_does_not_fit(self, button_panel: GpioKeys) -> None:  # type: ignore[override]
        with pytest.raises(DeviceRefused):
            button_panel.show(0, np.zeros((8, 8, 3), np.uint8), deadline=in_seconds(PATIENCE_S))


def test_each_key_is_told_once_and_in_its_order(board: Board, keys: GpioKeys) -> None:
    for line in (2, 0, 1):
        press(board[0], line)
    told = [keys.wait_pressed(deadline=in_seconds(PATIENCE_S)) for _ in range(3)]
    assert told == [RECALIBRATE, PLAY, STOP]
    assert keys.wait_pressed(deadline=in_seconds(1.0)) is None


def test_debian_sees_who_has_the_lines(board: Board, keys: GpioKeys) -> None:
    path = keys.identity(deadline=in_seconds(PATIENCE_S)).serial
    told = subprocess.run(["gpioinfo", path], check=True, capture_output=True, text=True).stdout.splitlines()
    assert ["velatura" in line for line in told[1:5]] == [True, True, True, False]
    assert all("input" in line for line in told[1:4])
    assert ["active-low" in line for line in told[1:4]] == [True, False, True]


def test_edges_are_used_where_the_chip_has_interrupts(board: Board, keys: GpioKeys) -> None:
    edges = keys.call(lambda lines: lines.edges, deadline=in_seconds(PATIENCE_S))
    assert edges is isinstance(board[0], Cp2112)


def test_a_contact_that_bounces_is_one_press(board: Board, keys: GpioKeys) -> None:
    adapter = board[0]
    for _ in range(6):
        adapter.levels[0] = not adapter.levels[0]
        time.sleep(0.002)
    press(adapter, 0)
    assert keys.wait_pressed(deadline=in_seconds(PATIENCE_S)) == PLAY
    assert keys.wait_pressed(deadline=in_seconds(1.0)) is None


@pytest.mark.parametrize("board", [Mcp2221], indirect=True, ids=["Mcp2221"])
def test_an_adapter_that_is_busy_for_some_looks_keeps_its_lines(board: Board, keys: GpioKeys) -> None:
    """Its driver makes EAGAIN of that; it also mixes up its own first questions with ours, with the same end."""
    adapter = board[0]
    assert isinstance(adapter, Mcp2221)
    before = keys.call(lambda lines: lines, deadline=in_seconds(PATIENCE_S))
    adapter.busy = ENOUGH_LOOKS
    press(adapter, 0)  # no one asks meanwhile, so no one opens them again
    assert adapter.busy == 0
    assert keys.wait_pressed(deadline=in_seconds(PATIENCE_S)) == PLAY
    assert keys.call(lambda lines: lines, deadline=in_seconds(PATIENCE_S)) is before


def test_lines_that_another_program_has_are_refused(board: Board, keys: GpioKeys) -> None:
    with pytest.raises(DeviceError) as caught:
        opened(LABELS[type(board[0])])
    assert caught.value.code == "gpio-not-opened"


def test_an_unplugged_adapter_is_gone_and_its_keys_come_back(board: Board, keys: GpioKeys) -> None:
    adapter, cables = board
    threading.Timer(1.0, cables[-1].pull).start()
    with pytest.raises(DeviceGone):
        keys.wait_pressed(deadline=in_seconds(PATIENCE_S))
    cables.append(Cable(adapter, list(LABELS).index(type(adapter))))
    ends = in_seconds(PATIENCE_S)
    while True:
        with contextlib.suppress(DeviceError):
            keys.identity(deadline=in_seconds(PATIENCE_S))
            break
        assert not ends.passed
        time.sleep(0.2)
    press(adapter, 0)
    assert keys.wait_pressed(deadline=in_seconds(PATIENCE_S)) == PLAY
