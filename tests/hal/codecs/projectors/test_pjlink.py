"""The PJLink codec against the specification's examples and against anything else."""

from __future__ import annotations

import hashlib
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.codecs.projectors import pjlink
from hal.codecs.projectors.pjlink import Failure, LampStatus, MuteStatus
from hal.errors import ProtocolError
from hal.values import Power


def test_the_password_is_hashed_as_in_the_specification() -> None:
    # "PJLink Specifications" 5.1: random number 498e4a67, password JBMIAProjectorLink
    greeting = pjlink.parse_greeting(b"PJLINK 1 498e4a67\r")
    assert greeting is not None
    assert greeting.random is not None
    assert pjlink.digest(greeting.random, "JBMIAProjectorLink") == b"5d8409bc1c3fa39749434aa3a5c38682"


def test_greetings() -> None:
    greeting = pjlink.parse_greeting(b"PJLINK 0\r")
    assert greeting is not None
    assert greeting.random is None
    assert pjlink.parse_greeting(b"PJLINK ERRA\r") is None
    for wrong in (b"", b"PJLINK\r", b"PJLINK 1\r", b"PJLINK 1 1?\r", b"PJLINK 2\r", b"PJLINK 0", b"PJLINK 0\r\n"):
        with pytest.raises(ProtocolError):
            pjlink.parse_greeting(wrong)


@pytest.mark.parametrize(
    ("line", "random"),
    [
        (b"\0PJLINK 0\r", None), (b"  PJLINK 0\r", None), (b"PJLINK 0 \r", None), (b"\n>PJLINK 0\r", None),
        (b"pjlink 0\r", None), (b"PJLINK 1 5\r", "5"), (b"PJLINK 1 00ff00ff00ff \r", "00ff00ff00ff"),
    ],
)  # fmt: skip
def test_greetings_that_projectors_were_seen_to_send(line: bytes, random: str | None) -> None:
    greeting = pjlink.parse_greeting(line)
    assert greeting is not None
    assert greeting.random == random


def test_the_second_level_mixes_both_random_numbers_and_the_password() -> None:
    theirs = pjlink.parse_second_level(b"PJLINK 2 0f0f0f0f0f0f0f0f0f0f0f0f0f0f0f0f\r")
    assert theirs == b"\x0f" * 16
    sent = pjlink.second_level_digest(theirs, b"\xff" * 16, "JBMIAProjectorLink")
    assert sent[:32] == b"ff" * 16
    assert sent[32:].decode() == hashlib.sha256(b"f0" * 16 + b"JBMIAProjectorLink").hexdigest()
    for other in (b"PJLINK ERRA\r", b"PJLINK 2\r", b"PJLINK 2 0f\r", b"%1POWR=ERR1\r", b"\r", b""):
        assert pjlink.parse_second_level(other) is None


@given(st.binary(max_size=160))
def test_a_second_level_answer_is_16_bytes_or_none(line: bytes) -> None:
    for data in (line, b"PJLINK 2 " + line + b"\r"):
        theirs = pjlink.parse_second_level(data)
        assert theirs is None or len(theirs) == pjlink.SALT_BYTES


def test_commands_are_bytes_of_the_specification() -> None:
    assert pjlink.command("POWR") == b"%1POWR ?\r"
    assert pjlink.command("AVMT", "31") == b"%1AVMT 31\r"
    assert pjlink.command("SNUM", pj_class=2) == b"%2SNUM ?\r"


@pytest.mark.parametrize(
    ("name", "parameter"), [("POW", "?"), ("powr", "?"), ("POWR", ""), ("POWR", "1\r"), ("POWR", "x" * 129)]
)
def test_commands_that_the_specification_does_not_allow_are_our_mistake(name: str, parameter: str) -> None:
    with pytest.raises(ProtocolError) as caught:
        pjlink.command(name, parameter)
    assert caught.value.theirs is False


def test_answers_belong_to_their_question() -> None:
    assert pjlink.parse_answer(b"%1POWR=1\r", "POWR") == "1"
    assert pjlink.parse_answer(b"%1powr=1\r", "POWR") == "1"
    assert pjlink.parse_answer(b"%1INFO=\r", "INFO") == ""
    assert pjlink.parse_answer(b"%1POWR=err3\r", "POWR") is Failure.UNAVAILABLE
    for wrong in (
        b"%1INPT=31\r",
        b"%2POWR=1\r",
        b"%1POWR 1\r",
        b"%1POWR=1",
        b"POWR=1\r",
        b"%1POWR=" + b"1" * 129 + b"\r",
    ):
        with pytest.raises(ProtocolError):
            pjlink.parse_answer(wrong, "POWR")


def test_values() -> None:
    assert [pjlink.parse_power(text) for text in "0123"] == [Power.OFF, Power.ON, Power.COOLING, Power.WARMING]
    assert pjlink.parse_errors("000000") == ()
    assert pjlink.parse_errors("120000") == ("fan-warning", "lamp-failed")
    assert pjlink.parse_errors("002001") == ("over-temperature", "other-warning")
    assert pjlink.parse_lamps("1200 1 80 0") == (LampStatus(1200, True), LampStatus(80, False))
    assert pjlink.parse_inputs("11 12 31") == ("11", "12", "31")
    assert pjlink.parse_mute("31") == MuteStatus(True, True)
    assert pjlink.parse_mute("11") == MuteStatus(True, False)
    assert pjlink.parse_mute("21") == MuteStatus(False, True)
    assert pjlink.parse_mute("30") == MuteStatus(False, False)
    assert pjlink.parse_text(" A\x1b[31m name ") == "A[31m name"


@pytest.mark.parametrize(
    ("parse", "text"),
    [
        (pjlink.parse_power, "44"),
        (pjlink.parse_power, "\u0661"),
        (pjlink.parse_errors, "00000"),
        (pjlink.parse_errors, "000003"),
        (pjlink.parse_lamps, "1200"),
        (pjlink.parse_lamps, "1200 2"),
        (pjlink.parse_lamps, "123456 1"),
        (pjlink.parse_lamps, " ".join(["1 1"] * 9)),
        (pjlink.parse_lamps, "1200  1"),
        (pjlink.parse_inputs, ""),
        (pjlink.parse_inputs, "11 71"),
        (pjlink.parse_inputs, " ".join(["11"] * 51)),
        (pjlink.parse_mute, "41"),
        (pjlink.parse_mute, "1"),
        (pjlink.parse_class, "3"),
        (pjlink.accepted, "ERR1"),
    ],
)
def test_values_that_the_specification_does_not_have_are_refused(parse: Callable[[str], object], text: str) -> None:
    with pytest.raises(ProtocolError):
        parse(text)


PARSERS: list[Callable[[str], object]] = [
    pjlink.parse_power,
    pjlink.parse_errors,
    pjlink.parse_lamps,
    pjlink.parse_input,
    pjlink.parse_inputs,
    pjlink.parse_mute,
    pjlink.parse_text,
    pjlink.parse_class,
    pjlink.accepted,
]


@given(st.sampled_from(PARSERS), st.one_of(st.text(max_size=60), st.text("0123456789 ", max_size=60)))
def test_no_value_ends_in_anything_but_a_protocol_error(parse: Callable[[str], object], text: str) -> None:
    try:
        parse(text)
    except ProtocolError as error:
        assert error.theirs  # noqa: PT017 - whether it raises at all depends on the text


@given(st.binary(max_size=160))
def test_no_line_ends_in_anything_but_a_protocol_error(line: bytes) -> None:
    for parse in (pjlink.parse_greeting, lambda data: pjlink.parse_answer(data, "POWR")):
        try:
            parse(line)
        except ProtocolError as error:
            assert error.theirs  # noqa: PT017 - as above


@given(st.text(st.characters(codec="utf-8", exclude_characters="\r"), max_size=30))
def test_any_name_comes_through_printable(name: str) -> None:
    told = pjlink.parse_answer(f"%1NAME={name}\r".encode(), "NAME")
    if isinstance(told, str):
        assert pjlink.parse_text(told).isprintable()
