"""Projectors on their LAN port whose answers differ from their family's, one row each. Real sockets."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from typing import Any

import pytest

from hal.deadline import in_seconds
from hal.errors import DeviceRefused, ProtocolError
from hal.values import Power
from lab.emulated.projectors.boards import BOARDS
from lab.emulated.projectors.boards_marked import BarcoPulseBoard
from plugins.emulated.projectors.lamp import EmulatedLamp
from tests.plugins.projectors.odd_board import OddBoard
from tests.plugins.projectors.switching import SOON, status, switches_without_hours

SDCP = bytes.fromhex("02 0A 53 4F 4E 59")


def quick(text: str) -> str:
    """Answers that do not come are given up soon."""
    text = re.sub(r"(?m)^answer_s = .*$", "answer_s = 0.4", text)
    return re.sub(r"(?m)^late_s = .*$", "late_s = 0.6", text)


def odd(family: str, question: bytes, answer: bytes | None) -> Callable[[EmulatedLamp], OddBoard]:
    return lambda lamp: OddBoard(BOARDS[family](lamp), {question: answer})


class OddBarco(BarcoPulseBoard):
    """One that answers a property otherwise: ``results`` by property, an exception's text for an error."""

    def __init__(self, lamp: EmulatedLamp, results: dict[str, object]) -> None:
        super().__init__(lamp)
        self._results = results

    def _act(self, method: str, params: dict[str, Any]) -> object:
        if method == "property.get" and params.get("property") in self._results:
            return self._results[str(params["property"])]
        return super()._act(method, params)


@pytest.mark.parametrize(
    ("family", "question", "answer"),
    [
        ("sony-adcp", b"timer ?\r\n", None),
        ("sony-adcp", b"timer ?\r\n", b"err_cmd\r\n"),
        ("sony-adcp", b"timer ?\r\n", b'[{"operation":12}]\r\n'),
        ("sony-adcp", b"timer ?\r\n", b'[{"light_src":"many"}]\r\n'),
        ("sony-sdcp", SDCP + bytes.fromhex("01 01 13 00"), None),
        ("sony-sdcp", SDCP + bytes.fromhex("01 01 13 00"), SDCP + bytes.fromhex("00 01 13 02 01 01")),
        ("sony-sdcp", SDCP + bytes.fromhex("01 01 13 00"), SDCP + bytes.fromhex("01 01 13 01 07")[:-2]),
        ("jvc", b"?\x89\x01IFLT\n", b"\x06\x89\x01IF\n@\x89\x01IFxyz\n"),
        ("viewsonic", bytes.fromhex("07 14 00 05 00 34 00 00 15 01 63"), bytes.fromhex("00 14 00 00 00 14")),
    ],
)
def test_hours_that_are_refused_or_mean_nothing_cost_nothing_else(
    open_network: Any, family: str, question: bytes, answer: bytes | None
) -> None:
    pair = open_network(profile=family, board=odd(family, question, answer), edit=quick)
    switches_without_hours(pair)
    assert len([notice.code for notice in pair.driver.notices()]) <= 1


@pytest.mark.parametrize("answer", [{"code": -32601, "message": "Property not found"}, "soon", None, [1, 2], -1])
def test_a_barco_that_tells_odd_hours_works(open_network: Any, answer: object) -> None:
    results = {"statistics.laserruntime.value": answer}
    switches_without_hours(open_network(profile="barco-pulse", board=lambda lamp: OddBarco(lamp, results), edit=quick))


@pytest.mark.parametrize("state", ["boot", "service"])
def test_a_barco_in_an_unknown_state_is_not_struck(open_network: Any, state: str) -> None:
    pair = open_network(profile="barco-pulse", board=lambda lamp: OddBarco(lamp, {"system.state": state}), edit=quick)
    assert status(pair).power is Power.UNKNOWN
    with pytest.raises(DeviceRefused):
        pair.driver.switch_on(deadline=in_seconds(SOON))
    assert pair.emulator.lamp.strikes == 0


@pytest.mark.parametrize("state", ["eco", "standby", "ready"])
def test_every_standby_of_a_barco_is_off(open_network: Any, state: str) -> None:
    pair = open_network(profile="barco-pulse", board=lambda lamp: OddBarco(lamp, {"system.state": state}))
    assert status(pair).power is Power.OFF


@pytest.mark.parametrize(
    ("state", "power"),
    [
        ("saving_standby", Power.OFF),
        ("saving_cooling2", Power.COOLING),
        ("startup", Power.WARMING),
        ("update", Power.UNKNOWN),
    ],
)
def test_every_state_of_a_sony_is_known(open_network: Any, state: str, power: Power) -> None:
    answer = json.dumps(state).encode() + b"\r\n"
    pair = open_network(profile="sony-adcp", board=odd("sony-adcp", b"power_status ?\r\n", answer), edit=quick)
    assert status(pair).power is power


def test_a_state_that_is_not_in_the_table_stays_an_error(open_network: Any) -> None:
    board = odd("sony-adcp", b"power_status ?\r\n", b'"dancing"\r\n')
    pair = open_network(profile="sony-adcp", board=board, edit=quick)
    with pytest.raises(ProtocolError):
        status(pair)
