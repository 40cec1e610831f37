"""Reports of relay boards and light sensors: whatever bytes come, a value or a ProtocolError."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.codecs.hid import (
    RelayState,
    SensorSettings,
    SensorState,
    channels_of,
    parse_reading,
    parse_settings,
    parse_state,
    switch_report,
)
from hal.errors import ProtocolError


@given(st.binary(max_size=20), st.integers(1, 8))
def test_any_relay_report_is_a_state_or_refused(data: bytes, channels: int) -> None:
    try:
        state = parse_state(data, channels)
    except ProtocolError:
        return
    assert len(data) == 9
    assert len(state.closed) == channels
    assert state.serial.isprintable()


@given(st.text("ABCXYZ0189", max_size=5), st.lists(st.booleans(), min_size=1, max_size=8))
def test_a_relay_report_is_read_bit_by_bit(serial: str, closed: list[bool]) -> None:
    bits = sum(1 << number for number, one in enumerate(closed) if one)
    report = b"\0" + serial.encode().ljust(5, b"\0") + b"\0\0" + bytes([bits])
    assert parse_state(report, len(closed)) == RelayState(serial, tuple(closed))


def test_a_relay_that_the_board_does_not_have_is_a_broken_report() -> None:
    with pytest.raises(ProtocolError):
        parse_state(b"\0ABCDE\0\0\x04", 2)


def test_commands_are_those_of_the_firmware() -> None:
    assert switch_report(3, True) == bytes([0, 0xFF, 3, 0, 0, 0, 0, 0, 0])
    assert switch_report(8, False) == bytes([0, 0xFD, 8, 0, 0, 0, 0, 0, 0])
    for channel in (0, 9, -1):
        with pytest.raises(ProtocolError) as caught:
            switch_report(channel, True)
        assert not caught.value.theirs


@pytest.mark.parametrize(
    ("product", "channels"), [("USBRelay1", 1), ("USBRelay8", 8), ("USBRelay9", None), ("USBRelay", None), ("", None)]
)
def test_boards_are_known_by_their_name(product: str, channels: int | None) -> None:
    assert channels_of(product) == channels


@given(st.binary(max_size=16))
def test_any_reading_is_light_or_refused(data: bytes) -> None:
    try:
        reading = parse_reading(data)
    except ProtocolError:
        return
    assert data[0] == 1
    assert len(data) == 7
    assert 0 <= reading.illuminance_lux <= (1 << 32) * 0.01


def test_a_reading_is_in_hundredths_of_a_lux() -> None:
    reading = parse_reading(struct.pack("<BBBI", 1, 2, 2, 1234))
    assert reading.illuminance_lux == pytest.approx(12.34)
    assert reading.state is SensorState.READY


@given(*[st.integers(0, 255)] * 4, st.integers(0, (1 << 32) - 1))
def test_settings_survive_the_way_there_and_back(a: int, b: int, c: int, d: int, interval_ms: int) -> None:
    settings = SensorSettings(a, b, c, d, interval_ms)
    assert parse_settings(settings.pack()) == settings
    with pytest.raises(ProtocolError):
        parse_settings(settings.pack()[:-1])
