"""The codec of PJLink's datagrams against the specification's forms and against anything else."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.codecs.projectors.pjlink import (
    InputChanged,
    LinkUp,
    PowerChanged,
    SearchAck,
    TroubleChanged,
    is_notification,
    parse_datagram,
)
from hal.errors import ProtocolError
from hal.values import Power


@pytest.mark.parametrize(
    ("data", "told"),
    [
        (b"%2ACKN=00:11:22:AA:BB:CC\r", SearchAck("00:11:22:aa:bb:cc")),
        (b"%2ACKN=001122aabbcc\r", SearchAck("00:11:22:aa:bb:cc")),
        (b"%2LKUP=00:11:22:AA:BB:CC\r\0\0\0", LinkUp("00:11:22:aa:bb:cc")),
        (b"%2ERST=020000\r", TroubleChanged(("lamp-failed",))),
        (b"%2ERST=000000\r", TroubleChanged(())),
        (b"%2POWR=3\r", PowerChanged(Power.WARMING)),
        (b"%2INPT=3A\r", InputChanged("3A")),
    ],
)
def test_every_datagram_of_the_specification_is_read(data: bytes, told: object) -> None:
    assert parse_datagram(data) == (told,)


def test_a_datagram_may_hold_several_lines() -> None:
    told = parse_datagram(b"%2POWR=1\r%2INPT=31\r")
    assert told == (PowerChanged(Power.ON), InputChanged("31"))


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\r",
        b"%2SRCH\r",
        b"%1POWR=1\r",
        b"%2POWR=1",
        b"%2POWR=7\r",
        b"%2POWR ?\r",
        b"%2LKUP=00:11:22:33:44\r",
        b"%2ACKN=00:11:22:33:44:55:66\r",
        b"%2ACKN=0:011:22:33:44:55\r",
        b"%2ERST=00000\r",
        b"%2POWR=1\r%2POWR=1",
        b"%2POWR=1\r" * 200,
    ],
)
def test_anything_else_is_refused_as_a_whole(data: bytes) -> None:
    with pytest.raises(ProtocolError) as caught:
        parse_datagram(data)
    assert caught.value.theirs


@given(st.binary(max_size=1500))
def test_no_datagram_ends_in_anything_but_a_meaning_or_a_protocol_error(data: bytes) -> None:
    try:
        told = parse_datagram(data)
    except ProtocolError:
        return
    assert told


def test_what_can_be_an_answer_is_never_taken_for_a_notification() -> None:
    assert is_notification(b"\0%2LKUP=00:11:22:AA:BB:CC\r")
    assert not is_notification(b"%2POWR=1\r")
    assert not is_notification(b"%1POWR=1\r")
