"""PTP-over-USB containers: what the standard says they look like, and that nothing else is taken for one."""

from __future__ import annotations

import contextlib
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.codecs.ptp import usb as ptp_usb
from hal.errors import ProtocolError

U16 = st.integers(0, 0xFFFF)
U32 = st.integers(0, 0xFFFF_FFFF)


def test_a_command_is_laid_out_as_in_the_standard() -> None:
    packed = ptp_usb.pack_command(0x1002, 7, (1,))
    assert packed == bytes.fromhex("10000000 0100 0210 07000000 01000000")


def test_data_and_cancellation_are_laid_out_as_in_the_standard() -> None:
    assert ptp_usb.pack_data(0x1016, 9, b"ab") == bytes.fromhex("0e000000 0200 1610 09000000 6162")
    assert ptp_usb.pack_cancel(0x01020304) == bytes.fromhex("0140 04030201")


@given(code=U16, transaction=U32, parameters=st.lists(U32, max_size=5))
def test_what_is_packed_is_parsed_again(code: int, transaction: int, parameters: list[int]) -> None:
    packed = ptp_usb.pack_command(code, transaction, tuple(parameters))
    assert ptp_usb.parse_header(packed) == (4 * len(parameters), ptp_usb.COMMAND, code, transaction)
    assert ptp_usb.parse_parameters(packed[12:]) == tuple(parameters)
    event = struct.pack("<IHHI", len(packed), ptp_usb.EVENT, code, transaction) + packed[12:]
    assert ptp_usb.parse_event(event + b"\0\0") == (code, tuple(parameters))


@given(st.binary(max_size=80))
def test_any_bytes_are_parsed_or_refused(data: bytes) -> None:
    for parse in (ptp_usb.parse_header, ptp_usb.parse_event, ptp_usb.parse_parameters, ptp_usb.parse_status):
        with contextlib.suppress(ProtocolError):
            parse(data)


@given(length=U32, kind=U16)
def test_only_data_may_be_longer_than_five_parameters(length: int, kind: int) -> None:
    header = struct.pack("<IHHI", length, kind, 0x2001, 1)
    allowed = (kind == 2 and length >= 12) or (kind in (1, 3, 4) and length in range(12, 33, 4))
    if allowed:
        assert ptp_usb.parse_header(header)[0] == (-1 if kind == 2 and length == 0xFFFF_FFFF else length - 12)
    else:
        with pytest.raises(ProtocolError):
            ptp_usb.parse_header(header)


def test_a_length_that_is_not_known_is_told_as_such() -> None:
    assert ptp_usb.parse_header(struct.pack("<IHHI", 0xFFFF_FFFF, 2, 0x1009, 1))[0] == -1


@given(code=U16, pipes=st.lists(U32, max_size=3))
def test_a_status_names_the_halted_pipes(code: int, pipes: list[int]) -> None:
    packed = struct.pack(f"<HH{len(pipes)}I", 4 + 4 * len(pipes), code, *pipes)
    assert ptp_usb.parse_status(packed) == ptp_usb.DeviceStatus(code, tuple(pipes))


def test_a_number_that_does_not_fit_is_our_mistake() -> None:
    with pytest.raises(ProtocolError) as caught:
        ptp_usb.pack_command(0x1002, 1, (1 << 32,))
    assert not caught.value.theirs
