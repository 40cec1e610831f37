"""PJLink projectors that differ from the specification, one row each, over real TCP."""

from __future__ import annotations

import time
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hal.deadline import in_seconds
from hal.errors import DeviceError, DeviceRefused, DeviceTimeout, ProtocolError
from hal.values import Power, ProjectorStatus
from lab.emulated.projectors.pjlink import EmulatedPjLinkProjector, PjLinkOddities
from tests.plugins.conftest import hasty
from tests.waiting import wait_for

SOON = 30.0


def status(pair: Any) -> ProjectorStatus:
    return pair.driver.status(deadline=in_seconds(SOON))  # type: ignore[no-any-return]


def works(pair: Any) -> None:
    """Everything that a calibration needs: on, shutter, off, status, identity; the lamp is struck once."""
    pair.driver.switch_on(deadline=in_seconds(SOON))
    wait_for(lambda: status(pair).power is Power.ON)
    pair.driver.set_shutter(True, deadline=in_seconds(SOON))
    assert pair.emulator.lamp.shutter_closed
    pair.driver.set_shutter(False, deadline=in_seconds(SOON))
    assert not pair.emulator.lamp.shutter_closed
    pair.driver.switch_off(deadline=in_seconds(SOON))
    assert status(pair).power in (Power.COOLING, Power.OFF)
    assert pair.emulator.lamp.strikes == 1
    assert pair.driver.identity(deadline=in_seconds(SOON)).model


KNOWN = {"LAMP": 1200, "ERST": (), "INST": ("11", "12", "31", "32"), "CLSS": "VE-0001"}
"""What the emulated projector answers where it is not odd; by CLSS the serial number, which only class 2 has."""


def told(pair: Any) -> dict[str, object]:
    now = status(pair)
    serial = pair.driver.identity(deadline=in_seconds(SOON)).serial
    return {"LAMP": now.lamp_hours, "ERST": now.faults, "INST": pair.driver.capabilities.inputs, "CLSS": serial}


UNKNOWN = {"LAMP": None, "ERST": (), "INST": (), "CLSS": ""}
NOT_UNDERSTOOD = [
    ("LAMP", b""), ("LAMP", b"29999"), ("LAMP", b"100 1 200 1 300 0 400"), ("LAMP", b"lots"), ("LAMP", b"100 lit"),
    ("LAMP", b"123456 1"), ("LAMP", b"\xff\xfe"), ("LAMP", None),
    ("ERST", b""), ("ERST", b"00000"), ("ERST", b"00000000"), ("ERST", b"29999"), ("ERST", b"ok"), ("ERST", None),
    ("INST", b""), ("INST", b"hdmi1"), ("INST", b"11,12"), ("INST", None),
    ("CLSS", b"Class 1"), ("CLSS", b""), ("CLSS", b"3"), ("CLSS", None),
]  # fmt: skip


@pytest.mark.parametrize(("field", "answer"), NOT_UNDERSTOOD)
def test_an_optional_answer_that_means_nothing_makes_its_field_unknown_and_is_noted_once(
    open_pjlink: Any, field: str, answer: bytes | None
) -> None:
    pair = open_pjlink(edit=hasty, odd=PjLinkOddities(answers={field: answer}))
    for _ in range(2):
        assert told(pair) == {**KNOWN, field: UNKNOWN[field]}
    assert pair.driver.capabilities.lamp_hours is (field != "LAMP")
    assert pair.driver.capabilities.errors is (field != "ERST")
    works(pair)
    notes = pair.driver.notices()
    assert [notice.code for notice in notes] == ["projector-answer-odd"]
    assert pair.emulator.address in notes[0].what
    assert "unknown" in notes[0].what
    assert pair.driver.notices() == []


@pytest.mark.parametrize(
    ("field", "answer", "means"),
    [
        ("LAMP", b"1200 1 ", 1200), ("LAMP", b" 1200 1", 1200), ("LAMP", b"1200 1 80 0 ", 1200),
        ("ERST", b"000000 ", ()), ("ERST", b"002000\x20\x20", ("over-temperature",)), ("INST", b"11 12 ", ("11", "12")),
        ("CLSS", b"2 ", "VE-0001"), ("LAMP", b"err1", None), ("LAMP", b"ERR3", None), ("ERST", b"ERR1", ()),
    ],
)  # fmt: skip
def test_blanks_and_refusals_are_understood_and_need_no_note(
    open_pjlink: Any, field: str, answer: bytes, means: object
) -> None:
    pair = open_pjlink(edit=hasty, odd=PjLinkOddities(answers={field: answer}))
    assert told(pair)[field] == means
    assert pair.driver.notices() == []


@pytest.mark.parametrize("name", ["INF1", "INF2", "INFO", "SNUM", "SVER"])
@pytest.mark.parametrize("answer", [b"", b"\xff", b"\x00\x1b[2J", None])
def test_a_projector_that_does_not_say_who_it_is_has_an_identity_nevertheless(
    open_pjlink: Any, name: str, answer: bytes | None
) -> None:
    pair = open_pjlink(edit=hasty, odd=PjLinkOddities(answers={name: answer}))
    who = pair.driver.identity(deadline=in_seconds(SOON))
    assert who.maker
    assert who.model
    assert f"{who.maker}{who.model}{who.serial}{who.firmware}".isprintable()


def test_every_optional_answer_may_be_missing_at_once_and_each_call_keeps_its_time(open_pjlink: Any) -> None:
    silent = dict.fromkeys(("INST", "LAMP", "ERST", "CLSS", "INF1", "INF2", "INFO", "NAME"))
    started = time.monotonic()
    pair = open_pjlink(edit=hasty, odd=PjLinkOddities(answers=silent))
    assert status(pair) == ProjectorStatus(Power.OFF)
    assert time.monotonic() - started < 20
    started = time.monotonic()
    assert status(pair) == ProjectorStatus(Power.OFF)
    assert time.monotonic() - started < 2, "questions that are never answered are not asked again and again"
    who = pair.driver.identity(deadline=in_seconds(SOON))
    assert (who.maker, who.model) == ("unknown", "PJLink projector")


@pytest.mark.parametrize("left_s", [0.3, 0.6, 1.0])
def test_a_silent_lamp_question_never_costs_the_power_state(open_pjlink: Any, left_s: float) -> None:
    pair = open_pjlink(edit=hasty)
    assert status(pair).lamp_hours == 1200
    pair.emulator.set_oddities(PjLinkOddities(answers={"ERST": None, "LAMP": None}))
    started = time.monotonic()
    try:
        assert pair.driver.status(deadline=in_seconds(left_s)).power is Power.OFF
    except DeviceTimeout:
        pytest.fail("the power state had been answered")
    assert time.monotonic() - started < left_s + 1.0


@pytest.mark.parametrize(
    ("answer", "error"),
    [
        (b"", ProtocolError),
        (b"44", ProtocolError),
        (b"1 1", ProtocolError),
        (b"on", ProtocolError),
        (None, DeviceTimeout),
    ],
)
def test_the_power_state_stays_strict(open_pjlink: Any, answer: bytes | None, error: type[DeviceError]) -> None:
    pair = open_pjlink(edit=hasty)
    pair.emulator.set_oddities(PjLinkOddities(answers={"POWR": answer}))
    with pytest.raises(error):
        pair.driver.status(deadline=in_seconds(SOON))


VARIANTS = {
    "NUL before the greeting": PjLinkOddities(before=b"\0"),
    "blanks before the greeting": PjLinkOddities(before=b"  "),
    "a blank after the greeting": PjLinkOddities(open_greeting=b"PJLINK 0 "),
    "a greeting in lower case": PjLinkOddities(open_greeting=b"pjlink 0"),
    "CR LF": PjLinkOddities(ending=b"\r\n"),
    "CR LF and a prompt": PjLinkOddities(ending=b"\r\n>"),
    "picture and sound are muted together": PjLinkOddities(mutes=(b"30", b"31")),
    "closes after each answer": PjLinkOddities(closes=True),
    "closes, CR LF and a prompt": PjLinkOddities(closes=True, ending=b"\r\n>"),
}


@pytest.mark.parametrize("password", [None, "secret"])
@pytest.mark.parametrize("name", VARIANTS)
def test_variants_of_the_protocol_work(open_pjlink: Any, name: str, password: str | None) -> None:
    known = {} if password is None else {"password": password}
    pair = open_pjlink(edit=hasty, odd=VARIANTS[name], password=password, settings=known)
    assert told(pair) == KNOWN
    works(pair)
    assert pair.driver.notices() == []


@pytest.mark.parametrize("digits", [1, 7, 9, 16, 64])
def test_random_numbers_of_other_lengths(open_pjlink: Any, digits: int) -> None:
    pair = open_pjlink(odd=PjLinkOddities(salt_digits=digits), password="secret", settings={"password": "secret"})
    assert status(pair).power is Power.OFF


@pytest.mark.parametrize("closes", [False, True])
def test_a_projector_that_refuses_md5_is_asked_for_its_second_level(open_pjlink: Any, closes: bool) -> None:
    odd = PjLinkOddities(second_level_only=True, closes=closes)
    pair = open_pjlink(edit=hasty, odd=odd, password="secret", settings={"password": "secret"})
    assert told(pair) == KNOWN
    works(pair)


@pytest.mark.parametrize("second_level_only", [False, True])
def test_a_wrong_password_is_refused_at_every_level(open_pjlink: Any, second_level_only: bool) -> None:
    with pytest.raises(DeviceRefused) as caught:
        open_pjlink(odd=PjLinkOddities(second_level_only=second_level_only), password="secret",
                    settings={"password": "wrong"})  # fmt: skip
    assert caught.value.code == "projector-password"


def test_a_shutter_that_cannot_be_moved_is_refused(open_pjlink: Any) -> None:
    pair = open_pjlink(edit=hasty, odd=PjLinkOddities(mutes=()))
    pair.driver.switch_on(deadline=in_seconds(SOON))
    with pytest.raises(DeviceRefused, match="ERR2"):
        pair.driver.set_shutter(True, deadline=in_seconds(SOON))


def test_a_strike_whose_answer_is_lost_is_not_repeated(open_pjlink: Any) -> None:
    pair = open_pjlink(edit=hasty)
    pair.emulator.set_oddities(PjLinkOddities(closes_unanswered="POWR 1"))
    pair.driver.switch_on(deadline=in_seconds(SOON))
    assert pair.emulator.heard.count(b"%1POWR 1") == 1
    assert pair.emulator.lamp.strikes == 1


def test_a_command_that_a_closed_connection_never_carried_is_sent_again_once(open_pjlink: Any) -> None:
    pair = open_pjlink(edit=hasty)
    pair.emulator.set_oddities(PjLinkOddities(closes=True))
    pair.driver.switch_on(deadline=in_seconds(SOON))
    assert pair.emulator.heard.count(b"%1POWR 1") == 1, "the projector read it once"
    assert pair.emulator.lamp.strikes == 1


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    answers=st.dictionaries(
        st.sampled_from(["INST", "LAMP", "ERST", "CLSS", "INF1", "INF2", "INFO", "SNUM", "SVER"]),
        st.binary(max_size=140).map(lambda data: data.replace(b"\r", b"")),
    )
)
def test_whatever_optional_questions_are_answered_the_power_state_is_told(
    odd_projector: tuple[Any, EmulatedPjLinkProjector], answers: dict[str, bytes]
) -> None:
    driver, emulator = odd_projector
    emulator.set_oddities(PjLinkOddities(answers=answers))
    assert driver.status(deadline=in_seconds(SOON)).power is Power.OFF
    assert driver.identity(deadline=in_seconds(SOON)).model


@pytest.fixture
def odd_projector(open_pjlink: Any) -> tuple[Any, EmulatedPjLinkProjector]:
    pair = open_pjlink(edit=hasty)
    return pair.driver, pair.emulator
