"""The serial codec with the table of every family, in the bytes of the makers' documents."""

from __future__ import annotations

import random
import re
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hal.codecs.projectors.profiles import parse_profile
from hal.codecs.projectors.serial_protocol import (
    Answer,
    Reply,
    UnaskedMessage,
    command_bytes,
    head_bytes,
    parse_hours,
    parse_line,
    query_bytes,
    rest_bytes,
)
from hal.codecs.projectors.serial_table import Query, SerialTable
from hal.errors import ProtocolError
from hal.values import Power

FOLDER = Path(__file__).parents[4] / "firmware_configs" / "projectors"


def table(name: str) -> SerialTable:
    made = parse_profile((FOLDER / f"{name}.toml").read_text(), file=name).serial
    assert made is not None
    return made


TABLES = {path.stem: table(path.stem) for path in sorted(FOLDER.glob("*.toml")) if path.stem != "pjlink"}
NEC_HOURS = bytes.fromhex("23 8A 01 31 62") + b"NP-PA500U".ljust(82, b"\0") + bytes.fromhex("C0 65 52 00") + bytes(12)
NEC_STATUS = bytes.fromhex("20 85 01 31 10 40 FF 01 00 00 04") + b"\xff" * 10


def summed(frame: bytes) -> bytes:
    return frame + bytes([sum(frame) & 0xFF])


@pytest.mark.parametrize(
    ("name", "command", "data"),
    [
        ("epson-escvp21", "power_on", b"PWR ON\r"),
        ("benq", "power_off", b"\r*pow=off#\r"),
        ("christie", "power_on", b"(#PWR 1)"),
        ("nec", "power_on", bytes.fromhex("02 00 00 00 00 02")),
        ("nec", "shutter_open", bytes.fromhex("02 11 00 00 00 13")),
        ("optoma-ep910", "shutter_close", b"IR040021"),
        ("panasonic", "power_on", bytes.fromhex("02 50 4F 4E 03")),
    ],
)
def test_commands_are_the_bytes_of_the_documents(name: str, command: str, data: bytes) -> None:
    assert command_bytes(TABLES[name], command, "") == data


def test_every_command_of_nec_bears_the_sum_of_its_bytes() -> None:
    nec = TABLES["nec"]
    commands = [command_bytes(nec, name, "") for name in nec.commands]
    for data in commands + [query_bytes(nec, query, "") for query in nec.queries.values()]:
        assert summed(data[:-1]) == data
        assert len(data) == data[4] + 6


@pytest.mark.parametrize(
    ("name", "question", "line", "meaning"),
    [
        ("epson-escvp21", "power", b"PWR=02\r:", Answer("warming")),
        ("epson-escvp21", "power", b"PWR=05\r", Answer("fault")),
        ("epson-escvp21", "power", b":", Reply.ACCEPTED),
        ("epson-escvp21", "lamp_hours", b"ERR\r:", Reply.REFUSED),
        ("benq", "power", b"*POW=ON#\r", Answer("on")),
        ("benq", "power", b">*pow=?#*pow=off#\r", Answer("off")),
        ("benq", "power", b">*pow=?#\r", Reply.NOTHING),
        ("benq", "power", b">\r", Reply.NOTHING),
        ("benq", "lamp_hours", b"*LTIM= 1383\r", Answer("1383")),
        ("benq", "model", b"*Block item#\r", Reply.REFUSED),
        ("christie", "power", b'(PWR!001 "On")', Answer("on")),
        ("christie", "power", b"(PWR!010)", Answer("cooling")),
        ("christie", "power", b'(65535 00000 ERR00005 "PWR: Too Few Parameters")', Reply.REFUSED),
        ("christie", "power", b'(65535 00000 FYI00000 "(SST+LAMP?001) Lamp Hours = 1:00 (h:m)")', Reply.NOTHING),
        ("christie", "power", b'(65535 00000 ERR00000 "System Error: Lamp")', UnaskedMessage(None, "system-error")),
        ("nec", "power", summed(NEC_STATUS), Answer("on")),
        ("nec", "lamp_hours", summed(NEC_HOURS), Answer("5400000")),
        ("nec", "model", summed(NEC_HOURS), Answer("NP-PA500U")),
        ("nec", "power", summed(bytes.fromhex("A0 85 01 31 02 02 0D")), Reply.REFUSED),
        ("optoma-ep910", "shutter", b"IR040021", Answer("closed")),
        ("optoma-ep910", "shutter", b"IR0500001", Reply.COOLING),
        ("optoma-ep910", "shutter", b"IR0500000", Reply.REFUSED),
        ("panasonic", "power", b"\x023\x03", Answer("cooling")),
        ("panasonic", "lamp_hours", b"\x021500\x03", Answer("1500")),
        ("panasonic", "lamp_hours", b"\x0265535\x03", Reply.REFUSED),
        ("panasonic", "lamp_hours", b"\x02ER401\x03", Reply.REFUSED),
    ],
)
def test_answers_mean_what_the_documents_say(name: str, question: str, line: bytes, meaning: object) -> None:
    query = TABLES[name].queries[question]
    assert parse_line(TABLES[name], line, query, sent=query_bytes(TABLES[name], query, "")) == meaning


def test_lamp_seconds_are_read_as_hours() -> None:
    query = TABLES["nec"].queries["lamp_hours"]
    answer = parse_line(TABLES["nec"], summed(NEC_HOURS), query)
    assert isinstance(answer, Answer)
    assert parse_hours(answer.value, query.per_hour) == 1500
    with pytest.raises(ProtocolError):
        parse_hours("4294967295", query.per_hour)


def test_a_frame_with_a_wrong_sum_is_garbage() -> None:
    with pytest.raises(ProtocolError):
        parse_line(TABLES["nec"], NEC_STATUS + b"\x00", TABLES["nec"].queries["power"])


@pytest.mark.parametrize(
    ("name", "head", "rest"),
    [("nec", b"\x20\x85\x01\x31\x10", 17), ("nec", b"\x22\0\1\1\0", 1), ("optoma-ep910", b"IR04", 4)],
)
def test_a_frame_tells_how_long_it_is(name: str, head: bytes, rest: int) -> None:
    frame = TABLES[name].frame
    assert frame is not None
    assert head_bytes(frame) == len(head)
    assert rest_bytes(frame, head, longest=TABLES[name].longest_answer) == rest


@pytest.mark.parametrize("head", [b"IRXX", b"IR-1", b"IR 4", b"IRFF"])
def test_a_count_that_cannot_be_is_refused(head: bytes) -> None:
    frame = TABLES["optoma-ep910"].frame
    assert frame is not None
    with pytest.raises(ProtocolError):
        rest_bytes(frame, head, longest=TABLES["optoma-ep910"].longest_answer)


@st.composite
def questions(draw: st.DrawFn) -> tuple[SerialTable, Query | None]:
    made = TABLES[draw(st.sampled_from(sorted(TABLES)))]
    return made, draw(st.sampled_from([None, *made.queries.values()]))


@given(questions(), st.binary(max_size=140), st.booleans())
def test_no_line_ends_in_anything_but_a_meaning_or_a_protocol_error(
    asked: tuple[SerialTable, Query | None], line: bytes, whole: bool
) -> None:
    made, query = asked
    try:
        meaning = parse_line(made, summed(line) if whole else line, query, sent=line[:9])
    except ProtocolError as error:
        assert error.theirs  # noqa: PT017 - whether it raises at all depends on the line
        return
    assert isinstance(meaning, Answer | UnaskedMessage | Reply)


def letters(text: str, source: random.Random) -> str:
    return "".join(source.choice((mark.lower(), mark.upper())) for mark in text)


def blanks(text: str, source: random.Random) -> str:
    """With blanks beside each mark that is no letter, figure or control character."""
    return re.sub(r"([*=#!;])", lambda mark: f"{' ' * source.randrange(3)}{mark[1]}{' ' * source.randrange(3)}", text)


DIALECTS = {
    "epson-escvp21": ("PWR={}\r:", {"00": "off", "01": "on", "02": "warming", "03": "cooling", "05": "fault"}),
    "optoma-later": ("OK{}\r", {"0": "off", "1": "on"}),
    "panasonic": ("\x02{}\x03", {"0": "off", "1": "warming", "2": "on", "3": "cooling"}),
    "panasonic-dz": ("\x02{}\x03", {"0": "off", "1": "warming", "2": "on", "3": "cooling"}),
    "benq": ("*POW={}#\r", {"ON": "on", "OFF": "off"}),
    "christie": ('(PWR!{} "Text")', {"0": "off", "1": "on", "10": "cooling", "11": "warming", "23": "unknown"}),
}
"""The answer to the question for the power state, and its values, in the makers' documents."""
ADDRESSES = {
    "panasonic": ("\x02", ("", "ADZZ;", "AD01;", "adzz;")),
    "panasonic-dz": ("\x02", ("", "ADZZ;", "AD64;")),
    "christie": ("(", ("", "65535 00001 ", "00001 ", "0 65535 ")),
}


@pytest.mark.parametrize(("name", "value", "word"), [
    (name, value, word) for name, (_, values) in DIALECTS.items() for value, word in values.items()
])  # fmt: skip
@given(seed=st.integers(0, 10_000))
@settings(max_examples=40, deadline=None)
def test_the_dialects_of_models_that_users_report_are_understood(name: str, value: str, word: str, seed: int) -> None:
    source = random.Random(seed)
    digits = value.zfill(source.randrange(6)) if value.isdigit() else value
    text = blanks(letters(DIALECTS[name][0].format(digits), source), source)
    mark, addresses = ADDRESSES.get(name, ("", ("",)))
    text = text.replace(mark, mark + source.choice(addresses), 1) if mark else text
    query = TABLES[name].queries["power"]
    sent = query_bytes(TABLES[name], query, "ZZ")
    assert parse_line(TABLES[name], text.encode("latin-1"), query, sent=sent) == Answer(word)


@pytest.mark.parametrize(
    ("name", "line", "meaning"),
    [
        ("epson-escvp21", b"err\r:", Reply.REFUSED),
        ("optoma-later", b"p\r", Reply.ACCEPTED),
        ("optoma-later", b"info01\r", UnaskedMessage(Power.WARMING, None)),
        ("panasonic-dz", b"\x02ADZZ;PON\x03", Reply.ACCEPTED),
        ("panasonic-dz", b"\x02AD01;ER401\x03", Reply.REFUSED),
        ("benq", b"* POW = ON #\r", Reply.ACCEPTED),
        ("benq", b"*pow=?#\r", Reply.NOTHING),
        ("benq", b"*block item#\r", Reply.REFUSED),
        ("christie", b"(65535 00001 #PWR 1)", Reply.ACCEPTED),
        ("christie", b'(00001 65535 ERR00005 "Bad")', Reply.REFUSED),
    ],
)
def test_replies_in_a_dialect_are_understood(name: str, line: bytes, meaning: object) -> None:
    assert parse_line(TABLES[name], line, None, sent=b"\r*pow=?#\r" if name == "benq" else b"") == meaning


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("optoma-later", b"OK12\r"), ("optoma-later", b"OKOK1\r"), ("epson-escvp21", b"PWR=11\r:"),
        ("panasonic", b"\x0200004\x03"), ("christie", b'(PWR!on "On")'), ("benq", b"*POW=ONE#\r"),
        ("benq", b"*P O W=ON#\r"),
    ],
)  # fmt: skip
def test_a_dialect_is_no_licence(name: str, line: bytes) -> None:
    with pytest.raises(ProtocolError):
        parse_line(TABLES[name], line, TABLES[name].queries["power"])
