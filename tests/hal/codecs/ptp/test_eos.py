"""Canon EOS records, settings and exposure codes."""

from __future__ import annotations

import contextlib
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hal.codecs.ptp.eos import (
    EosProperty,
    ImagePart,
    ObjectAdded,
    OtherRecord,
    PropertyChanged,
    StatusChanged,
    ValuesChanged,
    aperture_of,
    exposure_of,
    iso_of,
    pack_image_format,
    pack_setting,
    parse_image_format,
    parse_records,
)
from hal.errors import ProtocolError

END = struct.pack("<II", 8, 0)


def record(code: int, body: bytes) -> bytes:
    return struct.pack("<II", 8 + len(body), code) + body


def test_each_kind_of_record_is_understood() -> None:
    data = b"".join(
        (
            record(0xC189, struct.pack("<II", 0xD102, 0x60)),
            record(0xC18A, struct.pack("<IIIII", 0xD103, 3, 2, 0x48, 0x50)),
            record(0xC181, struct.pack("<IIIIIIII", 5, 0x10001, 0x3801, 0, 0, 1234, 2, 0) + b"IMG_0001.JPG\0"),
            record(0xC186, struct.pack("<IIIII", 0x91, 0xB103, 0, 99, 0) + b"IMG_0002.CR2\0\0\0"),
            record(0xC18B, struct.pack("<I", 1)),
            record(0xC1A5, b"whatever"),
            END,
            b"what follows the end is not looked at",
        )
    )
    assert parse_records(data) == (
        PropertyChanged(EosProperty.SHUTTER, struct.pack("<I", 0x60)),
        ValuesChanged(EosProperty.ISO, (0x48, 0x50)),
        ObjectAdded(5, 0x3801, 1234, "IMG_0001.JPG", waiting=False),
        ObjectAdded(0x91, 0xB103, 99, "IMG_0002.CR2", waiting=True),
        StatusChanged(busy=True),
        OtherRecord(0xC1A5),
    )


def test_no_bytes_and_the_end_alone_mean_that_nothing_changed() -> None:
    assert parse_records(b"") == parse_records(END) == ()


def test_the_list_of_image_formats_is_understood() -> None:
    raw_and_jpeg = (ImagePart(6, 0, 4), ImagePart(1, 0, 3))
    jpeg = (ImagePart(1, 0, 3),)
    body = struct.pack("<III", 0xD120, 3, 2) + pack_image_format(raw_and_jpeg) + pack_image_format(jpeg)
    assert parse_records(record(0xC18A, body) + END) == (ValuesChanged(0xD120, (), (raw_and_jpeg, jpeg)),)
    assert [part.raw for part in raw_and_jpeg] == [True, False]


@given(st.lists(st.builds(ImagePart, st.integers(0, 9), st.integers(0, 16), st.integers(0, 9)), min_size=1, max_size=2))
def test_an_image_format_survives_the_wire(parts: list[ImagePart]) -> None:
    assert parse_image_format(pack_image_format(tuple(parts))) == tuple(parts)


def test_a_setting_carries_its_own_size() -> None:
    assert pack_setting(0xD11C, 4) == struct.pack("<III", 12, 0xD11C, 4)
    assert pack_setting(0xD120, (ImagePart(1, 0, 3),)) == struct.pack("<IIIIIII", 28, 0xD120, 1, 16, 1, 0, 3)


@pytest.mark.parametrize(
    "data",
    [
        struct.pack("<II", 7, 0xC189),
        struct.pack("<II", 100, 0xC189),
        struct.pack("<II", 0xFFFF_FFFF, 0xC189),
        record(0xC189, b"\1\2"),
        record(0xC18A, struct.pack("<III", 0xD102, 3, 0x7FFF_FFFF)),
        record(0xC18A, struct.pack("<III", 0xD120, 3, 1) + struct.pack("<I", 3)),
        record(0xC186, bytes(12)),
        b"\1",
    ],
)
def test_a_record_that_lies_about_its_content_is_a_protocol_error(data: bytes) -> None:
    with pytest.raises(ProtocolError):
        parse_records(data)


@given(st.lists(st.tuples(st.sampled_from([0xC181, 0xC186, 0xC189, 0xC18A, 0xC18B, 0xC1A5]), st.binary(max_size=80))))
@settings(max_examples=300)
def test_hostile_records_end_in_a_protocol_error_or_in_records(parts: list[tuple[int, bytes]]) -> None:
    data = b"".join(record(code, body) for code, body in parts) + END
    with contextlib.suppress(ProtocolError):
        assert len(parse_records(data)) <= len(parts)


@given(st.binary(max_size=200))
def test_noise_instead_of_records_is_a_protocol_error_or_harmless(data: bytes) -> None:
    with contextlib.suppress(ProtocolError):
        parse_records(data)


# What bodies show for a code, in their menus and in other programs; the shutter's true time is a power of two near it.
SHOWN_S = {
    0x10: 30, 0x18: 15, 0x1B: 13, 0x20: 8, 0x2D: 2.5, 0x38: 1, 0x3B: 0.8, 0x40: 0.5, 0x48: 1 / 4, 0x5D: 1 / 25,
    0x60: 1 / 30, 0x68: 1 / 60, 0x6B: 1 / 80, 0x6D: 1 / 100, 0x70: 1 / 125, 0x74: 1 / 180, 0x80: 1 / 500,
    0x98: 1 / 4000, 0xA0: 1 / 8000,
}  # fmt: skip


@pytest.mark.parametrize(("code", "shown_s"), SHOWN_S.items())
def test_a_shutter_code_is_the_time_that_the_body_shows_to_within_its_rounding(code: int, shown_s: float) -> None:
    assert exposure_of(code) == pytest.approx(shown_s, rel=0.07)


def test_whole_stops_of_the_shutter_are_exact_powers_of_two() -> None:
    assert [exposure_of(code) for code in (0x10, 0x38, 0x68)] == [32.0, 1.0, 1 / 64]


@pytest.mark.parametrize("code", [0x00, 0x04, 0x0C, 0x39, 0xB0, 0xFFFF])
def test_bulb_auto_and_unknown_codes_are_no_exposure(code: int) -> None:
    assert exposure_of(code) is None


ISOS = {
    0x28: 6, 0x40: 50, 0x43: 64, 0x45: 80, 0x48: 100, 0x4B: 125, 0x4D: 160, 0x55: 320, 0x5D: 640, 0x63: 1000,
    0x65: 1250, 0x68: 1600, 0x78: 6400, 0x7D: 10000, 0x90: 51200, 0x95: 80000,
}  # fmt: skip
APERTURES = {
    0x08: 1.0, 0x0D: 1.2, 0x10: 1.4, 0x15: 1.8, 0x18: 2.0, 0x1B: 2.2, 0x20: 2.8, 0x25: 3.5, 0x2D: 5.0, 0x30: 5.6,
    0x33: 6.3, 0x38: 8.0, 0x40: 11.0, 0x48: 16.0, 0x50: 22.0, 0x58: 32.0,
}  # fmt: skip


@pytest.mark.parametrize(("code", "iso"), ISOS.items())
def test_an_iso_code_is_the_speed_that_the_body_shows(code: int, iso: int) -> None:
    assert iso_of(code) == iso


@pytest.mark.parametrize(("code", "number"), APERTURES.items())
def test_an_aperture_code_is_the_number_on_the_lens(code: int, number: float) -> None:
    assert aperture_of(code) == number


@given(st.integers(-10, 0x1_0000))
def test_every_code_is_a_value_or_none(code: int) -> None:
    for value in (exposure_of(code), iso_of(code), aperture_of(code)):
        assert value is None or value > 0
