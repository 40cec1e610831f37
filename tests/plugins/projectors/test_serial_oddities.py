"""Serial projectors whose optional answers differ from their family's, one row each, over real pseudo terminals."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import pytest

from hal.deadline import in_seconds
from hal.errors import DeviceRefused, DeviceTimeout, ProtocolError
from hal.values import Power, ProjectorStatus
from lab.emulated.projectors.boards import BOARDS
from lab.emulated.projectors.boards_text import SanyoBoard
from plugins.emulated.projectors.lamp import EmulatedLamp, LampPhase
from tests.plugins.conftest import each
from tests.plugins.projectors.odd_board import OddBoard
from tests.plugins.projectors.switching import SOON, status, switches_without_hours
from tests.waiting import wait_for

LAMP_QUESTION = {
    "optoma-later": b"~00108 1\r",
    "epson-escvp21": b"LAMP?\r",
    "benq": b"*ltim=?#\r",
    "christie": b"(LPH?)",
    "nec": bytes.fromhex("03 8A 00 00 00 8D"),
    "panasonic": b"\x02Q$L\x03",
    "sanyo": b"CR3\r",
    "panasonic-dz": b"\x02ADZZ;Q$L:1\x03",
    "jvc": b"?\x89\x01IFLT\n",
    "digital-projection": b"*laser.hours ?\r",
    "digital-projection-v": b"V99G0004\r",
    "hitachi": bytes.fromhex("BE EF 03 06 00 C2 FF 02 00 90 10 00 00"),
    "acer": b"* 0 Lamp\r",
    "viewsonic": bytes.fromhex("07 14 00 05 00 34 00 00 15 01 63"),
}
"""In the bytes of the makers' documents."""
END = {
    "epson-escvp21": b":", "christie": b")", "panasonic": b"\x03", "nec": b"",
    "panasonic-dz": b"\x03", "jvc": b"\n", "hitachi": b"", "viewsonic": b"",
}  # fmt: skip


def quick(text: str) -> str:
    """Answers that do not come are given up soon."""
    text = re.sub(r"(?m)^answer_s = .*$", "answer_s = 0.4", text)
    return re.sub(r"(?m)^late_s = .*$", "late_s = 0.6", text)


def impatient(text: str) -> str:
    return re.sub(r"(?m)^confirm_s = .*$", "confirm_s = 0.3", quick(text))


def odd(profile: str, answers: Mapping[bytes, bytes | None]) -> Callable[[EmulatedLamp], OddBoard]:
    usual = BOARDS[profile]
    return lambda lamp: OddBoard(usual(lamp), answers)


@pytest.mark.parametrize("answer", [None, b"", b"LAMP=many", b"\xff\xfe\x01", b"?!"], ids=repr)
def test_a_lamp_question_that_nobody_answers_well_costs_the_hours_and_nothing_else(
    open_serial: Any, answer: bytes | None
) -> None:
    def works(profile: str) -> None:
        said = None if answer is None else answer + END.get(profile, b"\r")
        board = odd(profile, {LAMP_QUESTION[profile]: said})
        pair = open_serial(profile=profile, name=profile, board=board, edit=quick)
        switches_without_hours(pair)
        assert pair.driver.identity(deadline=in_seconds(SOON)).maker
        notes = [notice.what for notice in pair.driver.notices() if notice.code == "projector-answer-odd"]
        assert len([text for text in notes if "lamp hours" in text]) <= 1
        assert pair.driver.notices() == []

    each(LAMP_QUESTION, works)


def test_a_silent_lamp_question_is_noted_once_and_not_asked_again_and_again(open_serial: Any) -> None:
    boards: list[OddBoard] = []

    def board(lamp: EmulatedLamp) -> OddBoard:
        boards.append(odd("panasonic", {LAMP_QUESTION["panasonic"]: None})(lamp))
        return boards[0]

    pair = open_serial(profile="panasonic", board=board, edit=quick)
    pair.emulator.lamp.warm_now()
    assert status(pair) == ProjectorStatus(Power.ON)
    asked = len(boards[0].heard)
    assert asked > 0
    started = time.monotonic()
    for _ in range(3):
        assert status(pair).lamp_hours is None
    assert len(boards[0].heard) == asked
    assert time.monotonic() - started < 3.0
    assert not pair.driver.capabilities.lamp_hours
    (notice,) = pair.driver.notices()
    assert notice.code == "projector-answer-odd"
    assert "lamp hours" in notice.what
    pair.driver.switch_off(deadline=in_seconds(SOON))
    wait_for(lambda: status(pair).power is Power.OFF)
    assert len(boards[0].heard) == asked, "another state of the lamp is no reason to wait for it again"


def test_lamp_hours_are_asked_once_and_not_with_each_status(open_serial: Any) -> None:
    boards: list[OddBoard] = []

    def board(lamp: EmulatedLamp) -> OddBoard:
        boards.append(odd("panasonic", {LAMP_QUESTION["panasonic"]: b"\x0201200\x03"})(lamp))
        return boards[0]

    pair = open_serial(profile="panasonic", board=board, edit=quick)
    pair.emulator.lamp.warm_now()
    assert [status(pair).lamp_hours for _ in range(4)] == [1200] * 4
    assert boards[0].heard.count(LAMP_QUESTION["panasonic"]) == 1


@pytest.mark.parametrize("left_s", [0.5, 0.8, 1.2])
def test_a_silent_lamp_question_never_costs_the_power_state(open_serial: Any, left_s: float) -> None:
    pair = open_serial(profile="panasonic", board=odd("panasonic", {LAMP_QUESTION["panasonic"]: None}), edit=quick)
    pair.emulator.lamp.warm_now()
    started = time.monotonic()
    assert pair.driver.status(deadline=in_seconds(left_s)) == ProjectorStatus(Power.ON)
    assert time.monotonic() - started < left_s + 1.0


@pytest.mark.parametrize(
    ("answer", "hours"),
    [(b"LAMP=1633 1633\r:", 1633), (b"LAMP=1633\r:", 1633), (b"LAMP=0 12\r:", 0), (b"LAMP=1 2 3\r:", 1)],
)
def test_an_epson_with_two_lamps_tells_the_hours_of_the_first(open_serial: Any, answer: bytes, hours: int) -> None:
    pair = open_serial(profile="epson-escvp21", board=odd("epson-escvp21", {b"LAMP?\r": answer}), edit=quick)
    pair.emulator.lamp.warm_now()
    assert status(pair) == ProjectorStatus(Power.ON, (), hours)


@pytest.mark.parametrize("code", [b"00", b"04", b"07", b"09"])
def test_every_standby_of_an_epson_is_off(open_serial: Any, code: bytes) -> None:
    pair = open_serial(profile="epson-escvp21", board=odd("epson-escvp21", {b"PWR?\r": b"PWR=%s\r:" % code}))
    assert status(pair).power is Power.OFF


def test_a_power_state_that_an_epson_does_not_have_stays_an_error(open_serial: Any) -> None:
    pair = open_serial(profile="epson-escvp21", board=odd("epson-escvp21", {b"PWR?\r": b"PWR=06\r:"}), edit=quick)
    with pytest.raises(ProtocolError):
        status(pair)


@pytest.mark.parametrize("lamps", [1, 2, 3, 4])
def test_a_sanyo_with_any_number_of_lamps_tells_the_hours_of_the_first(open_serial: Any, lamps: int) -> None:
    pair = open_serial(profile="sanyo", board=partial(SanyoBoard, lamps=lamps))
    pair.emulator.lamp.warm_now()
    assert status(pair).lamp_hours == 1200
    assert pair.driver.notices() == []


@pytest.mark.parametrize("code", [b"00003", b"00004", b"00005", b"00007", b"00009", b"00012"])
def test_a_christie_without_lamps_refuses_their_hours_by_any_number(open_serial: Any, code: bytes) -> None:
    refusal = b'(65535 00000 ERR%s "LPH: Unknown request")' % code
    pair = open_serial(profile="christie", board=odd("christie", {b"(LPH?)": refusal}), edit=quick)
    switches_without_hours(pair)
    assert pair.driver.notices() == []


@pytest.mark.parametrize("code", [*range(4, 10), *range(101, 119)])
def test_a_christie_on_its_way_is_unknown_is_not_struck_and_hears_off(open_serial: Any, code: int) -> None:
    told = {b"(PWR?)": b'(PWR!%03d "On its way")' % code}
    board = odd("christie", told)
    pair = open_serial(profile="christie", board=board, edit=impatient)
    assert status(pair).power is Power.UNKNOWN
    with pytest.raises(DeviceRefused) as refused:
        pair.driver.switch_on(deadline=in_seconds(SOON))
    assert refused.value.code == "projector-state-unknown"
    assert pair.emulator.lamp.strikes == 0
    pair.emulator.lamp.warm_now()
    with pytest.raises(DeviceTimeout) as late:
        pair.driver.switch_off(deadline=in_seconds(SOON))
    assert late.value.code == "projector-not-off"
    assert pair.emulator.lamp.phase is LampPhase.COOLING or pair.emulator.lamp.phase is LampPhase.STANDBY
