"""The TOML writer and the line scanner, against the standard library's parser."""

from __future__ import annotations

import math
import string
import tomllib
from collections.abc import Mapping
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.config import toml_text
from hal.toml_lines import KeyLines, KeyPath

KEYS = st.text(string.ascii_letters + string.digits + "_- .\"'#[]=é\\\n\t\x00\x7f", min_size=0, max_size=6)
TEXTS = st.text(st.characters(exclude_categories=["Cs"]), max_size=12)
VALUES = st.recursive(
    st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False) | TEXTS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner, max_size=3),
    max_leaves=8,
)
DOCUMENTS = st.dictionaries(KEYS, VALUES, max_size=5)


@settings(max_examples=300, deadline=None)
@given(DOCUMENTS)
def test_what_is_written_reads_back_the_same(document: dict[str, Any]) -> None:
    assert tomllib.loads(toml_text(document)) == document


@settings(max_examples=300, deadline=None)
@given(DOCUMENTS)
def test_every_key_of_any_document_has_its_line(document: dict[str, Any]) -> None:
    text = toml_text(document)
    lines = KeyLines(text)
    rows = text.split("\n")
    for path in key_paths(document, ()):
        row = rows[lines.line(path) - 1]
        key = next(part for part in reversed(path) if isinstance(part, str))
        assert spelled(key) in row, (path, row)


def spelled(key: str) -> str:
    """How the writer spells a key."""
    return toml_text({key: 0}).removesuffix(" = 0\n")


def key_paths(value: Any, path: KeyPath) -> list[KeyPath]:
    paths = [path] if path else []
    items = value.items() if isinstance(value, Mapping) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in items:
        paths += key_paths(inner, (*path, key))
    return paths


def test_lines_hold_through_everything_that_toml_allows() -> None:
    text = (
        'a.b = 1 # one\n"a".c = """\n[not.a.table]\nx = 1\\\n"""\n'  # 1, 2-5
        "d = [ # a list\n  1,\n  { e = 2, 'f' = '''\n]'''},\n]\n"  # 6-9, 10
        "[[t]]\nx = 1\n[t.u]\ny = 1\n[[t]]\n[t.u]\ny = 2\n[t.'v'.w]\nz = 1979-05-27 07:32:00\n"  # 11...
    )
    tomllib.loads(text)
    lines = KeyLines(text.replace("\n", "\r\n"))
    expected: dict[KeyPath, int] = {
        ("a", "b"): 1,
        ("a", "c"): 2,
        ("d",): 6,
        ("d", 0): 7,
        ("d", 1, "e"): 8,
        ("d", 1, "f"): 8,
        ("t", 0, "x"): 12,
        ("t", 0, "u", "y"): 14,
        ("t", 1): 15,
        ("t", 1, "u", "y"): 17,
        ("t", 1, "v", "w", "z"): 19,
        ("t", 1, "v", "w", "absent"): 18,
        ("absent",): 1,
    }
    assert {path: lines.line(path) for path in expected} == expected


@settings(max_examples=300, deadline=None)
@given(st.text("[]{}=\"'\\\n\r\t #.,abc019-_:é", max_size=60))
def test_the_line_scanner_holds_on_every_text_that_the_parser_accepts(text: str) -> None:
    try:
        document = tomllib.loads(text)
    except ValueError:
        return
    lines = KeyLines(text)
    assert all(1 <= lines.line(path) <= text.count("\n") + 1 for path in key_paths(document, ()))


@pytest.mark.parametrize("value", [object(), {1, 2}, b"bytes", [None]])
def test_what_toml_cannot_hold_is_refused(value: object) -> None:
    with pytest.raises(TypeError):
        toml_text({"key": value})


def test_floats_that_are_not_finite_are_written_as_toml_has_them() -> None:
    read = tomllib.loads(toml_text({"a": math.inf, "b": -math.inf, "c": math.nan, "d": 1e300, "e": 1e-7}))
    assert math.isnan(read.pop("c"))
    assert read == {"a": math.inf, "b": -math.inf, "d": 1e300, "e": 1e-7}
