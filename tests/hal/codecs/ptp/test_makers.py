"""The bytes of Nikon's and Sony's extensions, against examples written by hand."""

from __future__ import annotations

import contextlib
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.codecs.ptp import makers
from hal.codecs.ptp.datasets import Form
from hal.errors import ProtocolError


def test_a_nikon_reports_its_events_with_a_count_and_no_bytes_mean_none() -> None:
    data = bytes.fromhex("0200 0240 01000000 0d40 00000000".replace(" ", ""))
    assert makers.parse_nikon_events(data) == ((0x4002, 1), (0x400D, 0))
    assert makers.parse_nikon_events(b"") == ()
    with pytest.raises(ProtocolError, match="2 events"):
        makers.parse_nikon_events(data[:-1])


@pytest.mark.parametrize(
    ("value", "expected"),
    [(0x0001_00FA, 1 / 250), (0x000D_000A, 1.3), (0xFFFF_FFFF, None), (0, None), (0x1_0000, None)],
)
def test_exposure_times_are_fractions(value: int, expected: float | None) -> None:
    assert makers.nikon_seconds(value) == (None if expected is None else pytest.approx(expected))
    if value != 0xFFFF_FFFF:
        assert makers.sony_seconds(value) == (None if expected is None else pytest.approx(expected))


def test_live_view_begins_behind_its_header() -> None:
    assert makers.parse_nikon_view(bytes(384) + b"\xff\xd8\xff\xe0rest") == b"\xff\xd8\xff\xe0rest"
    with pytest.raises(ProtocolError):
        makers.parse_nikon_view(bytes(9000) + b"\xff\xd8\xff")


def entry(code: int, enabled: int, *second: int) -> bytes:
    first = struct.pack("<HHBBHHBH2H", code, 4, 1, enabled, 400, 560, 2, 2, 400, 560)
    return first + (struct.pack(f"<H{len(second)}H", len(second), *second) if second else b"")


def test_a_sony_lists_all_properties_and_its_second_list_counts() -> None:
    found = makers.parse_sony_properties(
        struct.pack("<II", 3, 0) + entry(0x5007, 1) + entry(0xD20D, 1, 1, 2, 3) + entry(0xD21E, 2)
    )
    assert list(found) == [0x5007, 0xD20D, 0xD21E]
    assert (found[0x5007].current, found[0x5007].form, found[0x5007].values) == (560, Form.ENUMERATION, (400, 560))
    assert found[0xD20D].values == (1, 2, 3)
    assert [one.writable for one in found.values()] == [True, True, False]


@given(data=st.binary(max_size=400))
def test_no_bytes_end_in_another_error(data: bytes) -> None:
    for parse in (
        makers.parse_nikon_events,
        makers.parse_nikon_codes,
        makers.parse_nikon_view,
        makers.parse_sony_properties,
    ):
        with contextlib.suppress(ProtocolError):
            parse(data)
