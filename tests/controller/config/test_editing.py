"""Editing a stage.toml that a person wrote."""

from __future__ import annotations

import string
import tomllib
from pathlib import Path
from typing import Any

import pytest
import tomlkit
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.config import load_stage, toml_text
from controller.config.writer import KeyChange, edited, rewrite_stage
from controller.core.errors import UsageError
from tests.controller.stage.sessions.run_models import STAGE

TEXT = STAGE.replace('port = "A"', 'port = "A"   # by the window') + "# the end\n"


def test_a_value_is_changed_and_its_comment_and_everything_else_stays() -> None:
    text = edited(TEXT, [KeyChange(("projectors", 0), "port", "C")])
    assert text == TEXT.replace('port = "A"   #', 'port = "C"   #')


def test_a_missing_key_is_added_to_its_own_table() -> None:
    text = edited(TEXT, [KeyChange(("projectors", 1), "baud", 19200)])
    assert tomllib.loads(text)["projectors"][1]["baud"] == 19200
    assert "baud" not in tomllib.loads(text)["projectors"][0]
    assert set(TEXT.splitlines()) <= set(text.splitlines())


def test_tables_are_added_after_the_end() -> None:
    text = edited(
        TEXT, (), {"projectors": [{"name": "third", "output": "P3", "driver": "model"}], "key_panel": {"driver": "k"}}
    )
    read = tomllib.loads(text)
    assert [one["name"] for one in read["projectors"]] == ["left", "right", "third"]
    assert read["key_panel"] == {"driver": "k"}
    assert text.startswith(TEXT.rstrip("\n"))


@pytest.mark.parametrize("value", ['"""\nA"""', '["A"]', '["A",\n  # or\n "B"]', "{ a = 1 }", "'A'", "1979-05-27"])
def test_a_value_of_any_kind_is_replaced_and_its_comment_stays(value: str) -> None:
    text = edited(TEXT.replace('"A"', value), [KeyChange(("projectors", 0), "port", "C")])
    assert text == TEXT.replace('"A"', '"C"')


def test_a_change_that_the_library_would_write_wrongly_is_refused_with_its_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(tomlkit, "dumps", lambda document: document.as_string().replace("P2", "P3"))
    with pytest.raises(UsageError) as caught:
        edited(TEXT, [KeyChange(("projectors", 0), "port", "C")])
    assert caught.value.code == "stage-not-editable"
    assert "line 7" in caught.value.what
    assert 'port = "C"' in caught.value.remedy


blanks = st.sampled_from(["", " ", "\t", "  "])
comments = st.sampled_from(["", "# why", ' # "quoted" = [1]', "   #"])
pairs = st.tuples(
    st.text(string.ascii_lowercase + "-_", min_size=1, max_size=8),
    st.one_of(st.integers(-9, 99), st.booleans(), st.floats(allow_nan=False), st.text(max_size=6), st.just([1, "a"])),
    st.tuples(blanks, blanks, blanks, blanks), comments,
)  # fmt: skip
tables = st.lists(pairs, min_size=1, max_size=4, unique_by=lambda pair: pair[0])
values = st.integers(-99, 99) | st.booleans() | st.floats(allow_nan=False) | st.text(max_size=8)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(st.lists(tables, min_size=1, max_size=3), st.sampled_from(["\n", "\r\n"]), comments, values, st.data())
def test_editing_one_key_keeps_everything_else_byte_for_byte(
    content: list[Any], end: str, between: str, value: Any, data: st.DataObject
) -> None:
    """Text is made of pieces, of which the value of one key is then another: and nothing else."""
    number = data.draw(st.integers(0, len(content) - 1))
    place = data.draw(st.integers(0, len(content[number]) - 1))

    def text(changed: bool) -> str:
        lines = ["# a stage"]
        for n, table in enumerate(content):
            lines += ["[[t]]" + between, ""] if n % 2 else [between.strip(), "[[t]]"]
            for k, (key, old, (before, left, right, behind), comment) in enumerate(table):
                shown = spelled_value(value if changed and (n, k) == (number, place) else old)
                lines.append(f"{before}{key}{left}={right}{shown}{behind}{comment}")
        return end.join([*lines, "", "# the end"])

    key = content[number][place][0]
    assert edited(text(False), [KeyChange(("t", number), key, value)]) == text(True)


def spelled_value(value: Any) -> str:
    return toml_text({"k": value}).removeprefix("k = ").removesuffix("\n")


@settings(max_examples=100, deadline=None, derandomize=True)
@given(st.lists(tables, min_size=1, max_size=3), comments, values, st.data())
def test_a_new_key_stands_in_its_table_and_every_line_stays(
    content: list[Any], between: str, value: Any, data: st.DataObject
) -> None:
    number = data.draw(st.integers(0, len(content) - 1))
    lines = ["# a stage"]
    for table in content:
        lines += ["", between.strip(), "[[t]]"]
        lines += [f"{key} = {spelled_value(old)} {comment}" for key, old, _, comment in table]
    text = "\n".join(lines) + "\n"
    found = edited(text, [KeyChange(("t", number), "NEW", value)])
    added = toml_text({"NEW": value})
    assert found.count(added) == 1
    assert found.replace(added, "") == text
    assert tomllib.loads(found)["t"][number]["NEW"] == value


@pytest.mark.parametrize(
    ("text", "path", "found"),
    [
        ("[a]\nx = 1\n\n# sub\n[a.b]\ny = 1", ("a",), "[a]\nx = 1\nNEW = 5\n\n# sub\n[a.b]\ny = 1"),
        ("[a]\nx = 1", ("a",), "[a]\nx = 1\nNEW = 5\n"),
        ("[a]\n\n# b\n[b]\n", ("a",), "[a]\nNEW = 5\n\n# b\n[b]\n"),
        ("a = { x = 1 } # c\n", ("a",), "a = { x = 1, NEW = 5} # c\n"),
        ("[[t]]\nx=1\n[t.u]\ny=1\n[[t]]\n", ("t", 0), "[[t]]\nx=1\nNEW = 5\n[t.u]\ny=1\n[[t]]\n"),
        ("[a]\nx=1\n[b]\n[a.c]\ny=1\n", ("a",), "[a]\nx=1\nNEW = 5\n[b]\n[a.c]\ny=1\n"),
        ("x = 1\n\n# a\n[a]\n", (), "x = 1\nNEW = 5\n\n# a\n[a]\n"),
        ("[a]\r\nx = 1\r\n\r\n[b]\r\n", ("a",), "[a]\r\nx = 1\r\nNEW = 5\r\n\r\n[b]\r\n"),
    ],
)
def test_a_new_key_stands_before_comments_and_tables_that_follow(
    text: str, path: tuple[str | int, ...], found: str
) -> None:
    assert edited(text, [KeyChange(path, "NEW", 5)]) == found


def test_the_ends_of_lines_stay_as_a_person_wrote_them(tmp_path: Path) -> None:
    file = tmp_path / "stage.toml"
    file.write_bytes(TEXT.replace("\n", "\r\n").encode())
    rewrite_stage(file, [KeyChange(("projectors", 1), "output", "P9")])
    assert file.read_bytes() == TEXT.replace('"P2"', '"P9"').replace("\n", "\r\n").encode()


def test_a_file_that_would_be_wrong_is_left_as_it_was(tmp_path: Path) -> None:
    file = tmp_path / "stage.toml"
    file.write_text(TEXT)
    with pytest.raises(UsageError) as caught:
        rewrite_stage(file, [KeyChange(("projectors", 1), "output", "P1")])
    assert "line" in caught.value.what
    assert file.read_text() == TEXT
    rewrite_stage(file, [KeyChange(("projectors", 1), "output", "P9")])
    assert load_stage(tmp_path).tables.projectors[1].output == "P9"
