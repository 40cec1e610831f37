"""Editing a stage.toml that a person wrote."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from controller.config import load_stage
from controller.config.editing import Change, edited, rewrite_stage
from controller.errors import UsageError
from tests.controller.test_app import STAGE

TEXT = STAGE.replace('port = "A"', 'port = "A"   # by the window') + "# the end\n"


def test_a_value_is_changed_and_its_comment_and_everything_else_stays() -> None:
    text = edited(TEXT, [Change(("projectors", 0), "port", "C")])
    assert text == TEXT.replace('port = "A"   #', 'port = "C"   #')


def test_a_missing_key_is_added_to_its_own_table() -> None:
    text = edited(TEXT, [Change(("projectors", 1), "baud", 19200)])
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


@pytest.mark.parametrize("value", ['"""\nA"""', '["A"]', "{ a = 1 }"])
def test_what_cannot_be_changed_safely_is_refused_with_its_line(value: str) -> None:
    text = TEXT.replace('"A"', value)
    with pytest.raises(UsageError) as caught:
        edited(text, [Change(("projectors", 0), "port", "C")])
    assert caught.value.code == "stage-not-editable"
    assert "line 7" in caught.value.what
    assert 'port = "C"' in caught.value.remedy


def test_a_file_that_would_be_wrong_is_left_as_it_was(tmp_path: Path) -> None:
    file = tmp_path / "stage.toml"
    file.write_text(TEXT)
    with pytest.raises(UsageError) as caught:
        rewrite_stage(file, [Change(("projectors", 1), "output", "P1")])
    assert "line" in caught.value.what
    assert file.read_text() == TEXT
    rewrite_stage(file, [Change(("projectors", 1), "output", "P9")])
    assert load_stage(tmp_path).tables.projectors[1].output == "P9"
