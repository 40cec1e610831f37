"""Which methods take part, and which scenes."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from controller.core.errors import UsageError
from lab.compare.entries import BUILT_IN, GROUP, entries
from lab.compare.scenes import chosen_scenes

SOURCE = '''
"""Two methods."""


def mine(stage):
    """Shows nothing. At all."""
    return lambda target: []


number = 3
'''


def test_without_names_all_that_are_shipped_take_part() -> None:
    names = ["ours", "paper", "inversion", "feathering", "single", "superresolution", "regression"]
    assert [entry.name for entry in entries(())] == names
    assert [entry.name for entry in entries(("single", "ours"))] == ["single", "ours"]
    assert all(len(entry.about) > 40 for entry in BUILT_IN)


def test_a_function_of_a_file_takes_part_and_is_done_again_when_it_has_changed(tmp_path: Path) -> None:
    file = tmp_path / "velatura_test_method.py"
    file.write_text(SOURCE)
    (entry,) = entries((f"{file}:mine",))
    assert (entry.name, entry.about) == ("mine", "Shows nothing. At all")
    before = entry.code_sha256()
    file.write_text(SOURCE + "\n# changed\n")
    assert before
    assert entries((f"{file}:mine",))[0].code_sha256() != before


def test_a_function_of_a_module_takes_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "velatura_test_module.py").write_text(SOURCE)
    monkeypatch.syspath_prepend(tmp_path)
    assert [entry.name for entry in entries(("velatura_test_module:mine", "ours"))] == ["mine", "ours"]
    monkeypatch.delitem(sys.modules, "velatura_test_module")


def test_an_installed_method_takes_part_without_being_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "velatura_test_installed.py").write_text(SOURCE)
    about = tmp_path / "velatura_test_installed-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: velatura-test-installed\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(f"[{GROUP}]\ntheirs = velatura_test_installed:mine\n")
    monkeypatch.syspath_prepend(tmp_path)
    found = entries(())
    assert [entry.name for entry in found][-1] == "theirs"
    assert found[-1].about == "Shows nothing. At all"
    monkeypatch.delitem(sys.modules, "velatura_test_installed")


@pytest.mark.parametrize(
    ("name", "code"),
    [
        ("theirs", "method-unknown"),
        ("no.such.module:mine", "method-unreadable"),
        ("{file}:yours", "method-unreadable"),
        ("{file}:number", "method-unreadable"),
        ("{file}x.py:mine", "method-unreadable"),
        ("ours", "method-twice"),
    ],
)
def test_other_names_are_refused(tmp_path: Path, name: str, code: str) -> None:
    file = tmp_path / "velatura_test_method.py"
    file.write_text(SOURCE)
    with pytest.raises(UsageError) as caught:
        entries(("ours", name.format(file=file)))
    assert caught.value.code == code


def test_scenes_come_in_their_own_order() -> None:
    assert [scene.name for scene in chosen_scenes(())] == ["dark", "flat", "room", "traced"]
    assert [scene.name for scene in chosen_scenes(("room", "dark"))] == ["dark", "room"]
    with pytest.raises(UsageError, match="no scene called hall"):
        chosen_scenes(("hall",))
