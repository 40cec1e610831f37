"""The serial codec, with the Optoma table."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.codecs.projectors.profiles import parse_profile
from hal.codecs.projectors.serial_protocol import (
    Answer,
    Reply,
    UnaskedMessage,
    command_bytes,
    parse_hours,
    parse_line,
    parse_power,
    query_bytes,
)
from hal.codecs.projectors.serial_table import SerialTable
from hal.errors import ProtocolError
from hal.values import Power


def optoma() -> SerialTable:
    folder = Path(__file__).parents[4] / "firmware_configs" / "projectors"
    table = parse_profile((folder / "optoma-later.toml").read_text()).serial
    assert table is not None
    return table


TABLE = optoma()
POWER = TABLE.queries["power"]
HOURS = TABLE.queries["lamp_hours"]


def test_commands_are_the_bytes_of_the_manual() -> None:
    # "7E 30 30 30 30 20 31 0D" and "7E 30 30 31 32 34 20 31 0D" in the manuals' HEX column
    assert command_bytes(TABLE, "power_on", "00") == bytes.fromhex("7E3030303020310D")
    assert query_bytes(TABLE, POWER, "00") == bytes.fromhex("7E303031323420310D")
    assert command_bytes(TABLE, "shutter_close", "07") == b"~0702 1\r"


@pytest.mark.parametrize(
    ("line", "meaning"),
    [
        (b"OK1\r", Answer("on")),
        (b"Ok0\r", Answer("off")),
        (b"\nOK1\r", Answer("on")),
        (b"P\r", Reply.ACCEPTED),
        (b"F\r", Reply.REFUSED),
        (b"INFO1\r", UnaskedMessage(Power.WARMING, None)),
        (b"INFO 2\r", UnaskedMessage(Power.COOLING, None)),
        (b"INFO7\r", UnaskedMessage(None, "over-temperature")),
        (b"INFO5\r", UnaskedMessage(None, "notice-5-warning")),
    ],
)
def test_lines_mean_what_the_manual_says(line: bytes, meaning: object) -> None:
    assert parse_line(TABLE, line, POWER) == meaning


@pytest.mark.parametrize("line", [b"\r", b"OK\r", b"OK2\r", b"OK1200\r", b"PF\r", b"pp\r", b"INFO\r", b"\xff\xfe\r"])
def test_lines_that_do_not_answer_the_power_question_are_refused(line: bytes) -> None:
    with pytest.raises(ProtocolError) as caught:
        parse_line(TABLE, line, POWER)
    assert caught.value.code == "projector-garbage"
    assert caught.value.theirs is True


def test_an_answer_without_its_question_is_not_an_answer() -> None:
    with pytest.raises(ProtocolError):
        parse_line(TABLE, b"OK1\r", None)


@pytest.mark.parametrize("value", ["", " ", "-1", "1.5", "100000", "1200h", "\u0661"])
def test_hours_are_one_to_five_digits(value: str) -> None:
    with pytest.raises(ProtocolError):
        parse_hours(value)
    assert parse_hours("01200") == 1200


def test_a_value_has_at_most_64_characters() -> None:
    assert parse_line(TABLE, b"OK" + b"7" * 64 + b"\r", HOURS) == Answer("7" * 64)
    with pytest.raises(ProtocolError):
        parse_line(TABLE, b"OK" + b"7" * 65 + b"\r", HOURS)


def test_a_power_word_outside_the_enum_is_refused() -> None:
    assert parse_power("cooling") is Power.COOLING
    with pytest.raises(ProtocolError):
        parse_power("dreaming")


@given(st.binary(max_size=80), st.sampled_from([None, POWER, HOURS]))
def test_no_line_ends_in_anything_but_a_meaning_or_a_protocol_error(line: bytes, query: object) -> None:
    try:
        meaning = parse_line(TABLE, line, query)  # type: ignore[arg-type]
    except ProtocolError:
        return
    assert isinstance(meaning, Answer | UnaskedMessage | Reply)


@given(st.integers(0, 99_999))
def test_any_hours_are_read_back(hours: int) -> None:
    meaning = parse_line(TABLE, b"OK%04d\r" % hours, HOURS)
    assert isinstance(meaning, Answer)
    assert parse_hours(meaning.value) == hours
