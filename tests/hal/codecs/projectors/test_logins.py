"""Logins of network ports and JSON-RPC: any bytes give a value or a typed error."""

from __future__ import annotations

import contextlib
import hashlib
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.codecs.projectors import logins
from hal.codecs.projectors.logins import NtGreeting
from hal.codecs.projectors.serial_protocol import Message, MessageKind, is_complete, json_bytes, parse_message
from hal.errors import DeviceBusy, DeviceError, DeviceRefused, ProtocolError


@given(st.binary(max_size=64))
def test_any_bytes_are_a_value_or_a_typed_error(data: bytes) -> None:
    for read in (
        lambda: logins.escvpnet_headers(data, "left"),
        lambda: logins.parse_ntcontrol_greeting(data),
        lambda: logins.parse_ntcontrol_answer(data, "left"),
        lambda: logins.adcp_proof(data, "secret", "left"),
        lambda: logins.check_adcp_accepted(data, "left"),
        lambda: logins.check_jvc_greeting(data, "left"),
        lambda: logins.jvc_accepted(data),
        lambda: parse_message(data, b'{"id": 1}'),
    ):
        with contextlib.suppress(DeviceError):
            read()


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.text(),
        lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    )
)
def test_any_json_is_a_value_or_a_typed_error(value: object) -> None:
    data = json.dumps(value).encode()
    try:
        message = parse_message(data, b'{"id": 1}')
    except ProtocolError:
        assert not isinstance(value, dict)
    else:
        assert all(" " <= character <= "~" for character in message.text)


def test_the_examples_of_the_makers_documents() -> None:
    assert logins.parse_ntcontrol_greeting(b"NTCONTROL 0\r") == NtGreeting()
    told = logins.parse_ntcontrol_greeting(b"NTCONTROL 1 23181e1e\r")
    assert told == NtGreeting("md5", "23181e1e")
    digest = hashlib.md5(b"admin1:panasonic:23181e1e").hexdigest().encode()
    assert logins.ntcontrol_command(b"QPW", told, "admin1", "panasonic") == digest + b"00QPW\r"
    assert logins.parse_ntcontrol_answer(b"00001\r", "left") == b"001"
    assert logins.parse_ntcontrol_answer(b"00000\r", "left") == b"000"
    assert logins.parse_ntcontrol_answer(b"ERR3\r", "left") == b"ERR3"
    assert logins.escvpnet_hello(None) == b"ESC/VP.net\x10\x03\x00\x00\x00\x00"
    assert logins.escvpnet_hello("pass") == b"ESC/VP.net\x10\x03\x00\x00\x00\x01\x01\x01pass" + b"\0" * 12
    assert logins.escvpnet_headers(b"ESC/VP.net\x10\x03\x00\x00\x20\x00", "left") == 0
    assert logins.jvc_requests("12345678")[0] == b"PJREQ_12345678\0\0"


@pytest.mark.parametrize(
    ("status", "error"), [(0x41, DeviceRefused), (0x43, DeviceRefused), (0x53, DeviceBusy), (0x45, ProtocolError)]
)
def test_what_escvpnet_refuses_is_told(status: int, error: type[DeviceError]) -> None:
    with pytest.raises(error):
        logins.escvpnet_headers(b"ESC/VP.net\x10\x03\0\0" + bytes([status, 0]), "left")


def test_only_the_answer_to_the_last_message_counts() -> None:
    sent = json_bytes("property.get system.state", 7)
    assert json.loads(sent) == {
        "jsonrpc": "2.0", "method": "property.get", "params": {"property": "system.state"}, "id": 7,
    }  # fmt: skip
    assert parse_message(b'{"jsonrpc":"2.0","id":7,"result":"on"}', sent) == Message(MessageKind.RESULT, "on")
    assert parse_message(b'{"jsonrpc":"2.0","id":"7","result":null}', sent) == Message(MessageKind.RESULT, "")
    assert parse_message(b'{"jsonrpc":"2.0","id":6,"result":"on"}', sent).said is MessageKind.OTHER
    assert parse_message(b'{"jsonrpc":"2.0","method":"property.changed"}', sent).said is MessageKind.OTHER
    assert parse_message(b'{"id":7,"error":{"code":-32601,"message":"no"}}', sent) == Message(MessageKind.ERROR, "no")
    assert parse_message(b'{"id":7,"error":"no"}', sent) == Message(MessageKind.ERROR, "no")


@given(st.binary(max_size=40), st.integers(0, 60))
def test_a_part_of_an_object_is_not_whole(noise: bytes, cut: int) -> None:
    whole = b'{"id": 1, "result": {"a": "}{", "b": [1, {"c": 2}]}}'
    assert is_complete(whole)
    assert not is_complete(whole[: min(cut, len(whole) - 1)])
    assert not is_complete(b"x" + noise)
