"""PTP values, datasets and PTP/IP packets: round trips, and hostile bytes that may only raise ProtocolError."""

from __future__ import annotations

import contextlib
import struct
import time
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hal.codecs.ptp import ip as ptp_ip
from hal.codecs.ptp import values as ptp
from hal.codecs.ptp.datasets import (
    DeviceInfo,
    Form,
    ObjectInfo,
    PropertyDescription,
    StorageInfo,
    Value,
    pack_value,
    parse_value,
)
from hal.errors import ProtocolError

CODES = st.integers(0, 0xFFFF)
NUMBERS = st.integers(0, 0xFFFF_FFFF)
NAMES = st.text(st.characters(min_codepoint=0x20, max_codepoint=0x7E), max_size=40)
WIDTHS = {
    1: (-(1 << 7), (1 << 7) - 1),
    2: (0, 255),
    4: (0, 65535),
    5: (-(1 << 31), (1 << 31) - 1),
    6: (0, (1 << 32) - 1),
}

device_infos = st.builds(
    DeviceInfo,
    vendor_extension=NUMBERS,
    operations=st.frozensets(CODES, max_size=60),
    events=st.frozensets(CODES, max_size=10),
    properties=st.frozensets(CODES, max_size=60),
    capture_formats=st.lists(CODES, max_size=8).map(tuple),
    image_formats=st.lists(CODES, max_size=8).map(tuple),
    manufacturer=NAMES,
    model=NAMES,
    version=NAMES,
    serial=NAMES,
)
object_infos = st.builds(
    ObjectInfo,
    storage=NUMBERS,
    format=CODES,
    size=NUMBERS,
    width_px=NUMBERS,
    height_px=NUMBERS,
    parent=NUMBERS,
    filename=NAMES,
    captured=NAMES,
)
storage_infos = st.builds(
    StorageInfo,
    kind=CODES,
    writable=st.booleans(),
    capacity=st.integers(0, (1 << 64) - 1),
    free=st.integers(0, (1 << 64) - 1),
    free_images=NUMBERS,
    description=NAMES,
    label=NAMES,
)


@st.composite
def descriptions(draw: st.DrawFn) -> PropertyDescription:
    kind = draw(st.sampled_from([*WIDTHS, 0xFFFF]))
    value: st.SearchStrategy[Value] = NAMES if kind == 0xFFFF else st.integers(*WIDTHS[kind])
    form = draw(st.sampled_from(list(Form)))
    counts = {Form.NONE: (0, 0), Form.RANGE: (3, 3), Form.ENUMERATION: (0, 20)}[form]
    values = draw(st.lists(value, min_size=counts[0], max_size=counts[1]))
    return PropertyDescription(draw(CODES), kind, draw(st.booleans()), draw(value), draw(value), form, tuple(values))


PARAMETERS = st.lists(NUMBERS, max_size=5).map(tuple)
GUIDS = st.binary(min_size=16, max_size=16)
packets = st.one_of(
    st.builds(ptp_ip.InitCommandRequest, GUIDS, NAMES, NUMBERS),
    st.builds(ptp_ip.InitCommandAck, NUMBERS, GUIDS, NAMES, NUMBERS),
    st.builds(ptp_ip.InitEventRequest, NUMBERS),
    st.builds(ptp_ip.InitEventAck),
    st.builds(ptp_ip.InitFail, NUMBERS),
    st.builds(ptp_ip.Request, NUMBERS, CODES, NUMBERS, PARAMETERS),
    st.builds(ptp_ip.Response, CODES, NUMBERS, PARAMETERS),
    st.builds(ptp_ip.Event, CODES, NUMBERS, PARAMETERS),
    st.builds(ptp_ip.StartData, NUMBERS, st.integers(0, (1 << 64) - 1)),
    st.builds(ptp_ip.Data, NUMBERS, st.binary(max_size=100)),
    st.builds(ptp_ip.Cancel, NUMBERS),
    st.builds(ptp_ip.EndData, NUMBERS, st.binary(max_size=100)),
    st.builds(ptp_ip.Ping),
    st.builds(ptp_ip.Pong),
)


@given(device_infos)
def test_a_device_info_survives_the_wire(info: DeviceInfo) -> None:
    assert DeviceInfo.parse(info.pack()) == info


@given(object_infos)
def test_an_object_info_survives_the_wire(info: ObjectInfo) -> None:
    assert ObjectInfo.parse(info.pack()) == info


@given(storage_infos)
def test_a_storage_info_survives_the_wire(info: StorageInfo) -> None:
    assert StorageInfo.parse(info.pack()) == info


@given(descriptions())
def test_a_property_description_survives_the_wire(description: PropertyDescription) -> None:
    assert PropertyDescription.parse(description.pack()) == description


@given(packets)
def test_a_packet_survives_the_wire(packet: ptp_ip.Packet) -> None:
    data = ptp_ip.pack(packet)
    length, kind = ptp_ip.parse_header(data[:8])
    assert (length, kind) == (len(data) - 8, packet.TYPE)
    assert ptp_ip.parse(kind, data[8:]) == packet


PARSERS: list[Callable[[bytes], object]] = [
    DeviceInfo.parse,
    ObjectInfo.parse,
    StorageInfo.parse,
    PropertyDescription.parse,
    ptp.parse_handles,
    *(lambda data, kind=kind: ptp_ip.parse(kind, data) for kind in range(1, 15)),
    *(lambda data, kind=kind: parse_value(data, kind) for kind in (2, 8, 0x4006, 0xFFFF, 0x1234)),
]


@given(st.binary(max_size=300))
@settings(max_examples=300)
def test_hostile_bytes_end_in_a_protocol_error_or_a_value(data: bytes) -> None:
    for parse in PARSERS:
        with contextlib.suppress(ProtocolError):
            parse(data)


@given(device_infos, st.integers(0, 400))
def test_a_truncated_device_info_is_a_protocol_error(info: DeviceInfo, length: int) -> None:
    data = info.pack()
    if length < len(data):
        with pytest.raises(ProtocolError):
            DeviceInfo.parse(data[:length])


def test_a_lying_array_count_reserves_no_memory() -> None:
    with pytest.raises(ProtocolError, match="4294967295 values"):
        ptp.parse_handles(b"\xff\xff\xff\xff" + bytes(16))


def test_a_lying_enumeration_count_is_a_protocol_error() -> None:
    head = struct.pack("<HHBBB", 0x5001, 2, 1, 0, 0)
    with pytest.raises(ProtocolError):
        PropertyDescription.parse(head + struct.pack("<BH", 2, 65535) + bytes(10))


@pytest.mark.parametrize(
    "header",
    [b"", bytes(7), struct.pack("<II", 7, 7), struct.pack("<II", 12, 0), struct.pack("<II", 12, 15),
     struct.pack("<II", 5000, 7), struct.pack("<II", 0xFFFF_FFFF, 10)],
)  # fmt: skip
def test_an_impossible_header_is_a_protocol_error(header: bytes) -> None:
    with pytest.raises(ProtocolError):
        ptp_ip.parse_header(header)


def test_an_answer_with_too_many_parameters_is_a_protocol_error() -> None:
    with pytest.raises(ProtocolError):
        ptp_ip.parse(7, struct.pack("<HI6I", 0x2001, 1, *range(6)))


def test_control_characters_in_a_devices_strings_do_not_reach_a_terminal() -> None:
    name = "evil\x1b[2J\u202e.jpg"
    info = ObjectInfo(1, 0x3801, 5, 0, 0, 0, name, "")
    parsed = ObjectInfo.parse(info.pack()).filename
    assert parsed.isprintable()
    assert parsed.startswith("evil")


@pytest.mark.parametrize(("kind", "value"), [(2, 256), (2, "text"), (0xFFFF, 3), (0xFFFF, "x" * 255), (0x1234, 1)])
def test_a_value_that_does_not_fit_is_our_mistake_and_not_sent(kind: int, value: Value) -> None:
    with pytest.raises(ProtocolError) as caught:
        pack_value(kind, value)
    assert not caught.value.theirs


def test_a_request_looks_as_the_standard_says() -> None:
    assert ptp_ip.pack(ptp_ip.Request(1, 0x1002, 0, (1,))) == bytes.fromhex(
        "16000000 06000000 01000000 0210 00000000 01000000"
    )


def test_headers_and_long_lists_are_read_fast_enough_to_be_no_cost() -> None:
    """Twenty times the goals of the benchmark, so that a loaded machine does not fail the test."""
    header = struct.pack("<II", 14, 7)
    started = time.thread_time()
    for _ in range(1000):
        ptp_ip.parse_header(header)
    assert (time.thread_time() - started) / 1000 < 20e-6
    handles = ptp.pack_array("I", range(5000))
    assert min(_seconds(lambda: ptp.parse_handles(handles)) for _ in range(20)) < 2e-3


def _seconds(work: Callable[[], object]) -> float:
    started = time.thread_time()
    work()
    return time.thread_time() - started
