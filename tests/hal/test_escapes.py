"""Bytes as printable ASCII, and back."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from hal.errors import ProtocolError
from hal.escapes import escaped
from lab.emulated.tape import unescaped


@given(st.binary(max_size=200))
def test_any_bytes_survive_the_notation(data: bytes) -> None:
    text = escaped(data)
    assert text.isascii()
    assert text.isprintable()
    assert unescaped(text) == data


@given(st.text(max_size=100))
def test_no_text_is_read_as_bytes_by_mistake(text: str) -> None:
    try:
        data = unescaped(text)
    except ProtocolError:
        return
    assert unescaped(escaped(data)) == data
