from __future__ import annotations

from pathlib import Path

import pytest

from controller.config import load_stage
from controller.core.errors import UsageError, VelaturaError
from controller.kiosk.store import settings
from tests.controller.kiosk.vase import TEXT, vase


@pytest.fixture
def stage(tmp_path: Path) -> Path:
    return vase(tmp_path / "stage")


def appearances(stage: Path) -> list[str]:
    return [table.name for table in load_stage(stage).tables.appearances]


def test_a_stage_without_settings_has_an_empty_text(tmp_path: Path) -> None:
    assert settings.text(tmp_path) == ""


def test_saved_settings_hold_and_the_ones_before_are_kept(stage: Path) -> None:
    settings.save(stage, TEXT.replace("The vase", "The bust"))
    assert load_stage(stage).tables.stage.name == "The bust"
    assert (stage / settings.BEFORE).read_text() == TEXT


WRONG = {
    "cut": (TEXT + "\n[stage", "TOML"),
    "a value": (TEXT.replace("iso = 100", 'iso = "fast"'), "iso"),
    "missing": (TEXT.replace('name = "The vase"', ""), "name"),
    "a table": (TEXT + "\n[camra]\n", "camra"),
    "a driver": (TEXT.replace('driver = "serial"', 'driver = "seriel"'), "seriel"),
    "a driver's own key": (TEXT.replace("port =", "prot ="), "prot"),
    "a profile that there is not": (TEXT.replace("optoma-later", "optoma-latest"), "optoma-latest"),
    "a camera's address": (TEXT.replace("ptpip:127.0.0.1", "ptpip:127.0.0.1:no"), "line"),
    "half of the hours": (TEXT + '\n[[schedule.hours]]\nday = "sun"\nopens = "16:11"\n', "16:11"),
    "no time zone": (TEXT + '\n[schedule]\ntime_zone = "Europe/Nowhere"\n', "Europe/Nowhere"),
    "too long": ("# " + "x" * (1 << 20), "too long"),
    "nested": ("a = " + 5000 * "[" + 5000 * "]", "TOML"),
}


@pytest.mark.parametrize("how", WRONG)
def test_wrong_settings_are_refused_by_name_and_change_nothing(stage: Path, how: str) -> None:
    wrong, told = WRONG[how]
    with pytest.raises(VelaturaError) as error:
        settings.save(stage, wrong)
    assert told in error.value.what
    assert error.value.remedy
    assert settings.text(stage) == TEXT
    assert not (stage / settings.BEFORE).exists()


def test_wrong_first_settings_leave_none(tmp_path: Path) -> None:
    with pytest.raises(VelaturaError):
        settings.save(tmp_path, TEXT.replace('driver = "serial"', 'driver = "seriel"'))
    assert list(tmp_path.iterdir()) == []


def test_an_uploaded_picture_becomes_an_appearance_once(stage: Path) -> None:
    for _ in range(2):
        settings.add_appearance(stage, {"name": "moss", "kind": "picture", "file": "appearances/moss.png"})
    assert appearances(stage) == ["marble", "glass", "moss"]


@pytest.mark.parametrize("name", ["marble", "glass"])
def test_one_appearance_is_taken_out_and_the_rest_stays_word_for_word(stage: Path, name: str) -> None:
    settings.remove_picture(stage, name)
    assert appearances(stage) == [one for one in ("marble", "glass") if one != name]
    left = settings.text(stage)
    assert set(left.splitlines()) < set(TEXT.splitlines())
    with pytest.raises(UsageError, match="no appearance"):
        settings.remove_picture(stage, name)


@pytest.mark.parametrize("name", ["", ".", "../up", "a b", "-x", "x" * 65, "a/b", "caf\u202ee", "a\n"])
def test_names_that_are_no_file_names_are_refused(name: str) -> None:
    with pytest.raises(UsageError, match="name"):
        settings.check_name(name)


def test_plain_names_are_accepted() -> None:
    for name in ("marble", "2", "Old_stone-3", "caf\u00e9"):
        settings.check_name(name)
