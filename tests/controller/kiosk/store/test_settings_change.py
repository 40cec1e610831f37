"""What changed settings restart, the settings that are kept for a bad day, and the first ones, which need a key."""

from __future__ import annotations

from pathlib import Path

import pytest

from controller.config import load_stage
from controller.core.errors import UsageError, WorkError
from controller.kiosk.api.kiosk import StageKiosk
from controller.kiosk.store import settings
from controller.kiosk.store.settings import GOOD, Change, GoodSettings, change, last_good
from controller.stage.sessions.calibrations import signing_key
from controller.stage.sessions.check import check_stage
from tests.controller.kiosk.vase import TEXT, vase

TWO = (
    TEXT.replace(
        "[camera]",
        """[[projectors]]
name = "right"
output = "P2"
driver = "serial"
port = "/dev/ttyUSB1"
profile = "optoma-later"

[camera]""",
    )
    + """
[[display.outputs]]
name = "P2"
width_px = 1400
height_px = 1050
"""
)
RELAY = """
[[relays]]
name = "board"
driver = "usb-relay"
[[relays.mains]]
channel = {}
feeds = ["right"]
"""


def between(before: str, after: str) -> Change:
    return change(settings.tables_of(before), settings.tables_of(after))


@pytest.mark.parametrize(
    ("after", "restarts", "lamps"),
    [
        (f"# a comment\n\n{TWO}", False, ()),
        (TWO.replace("The vase", "The bust"), False, ()),
        (TWO + "\n[solve]\nsmoothness = 0.01\n[disk]\nwarn_free_gb = 1.0\n", False, ()),
        (TWO.replace("iso = 100", "iso = 200"), True, ()),
        (TWO + "\n[safety]\npower_up_s = 99.0\n", True, ()),
        (TWO.replace("/dev/ttyUSB1", "/dev/ttyUSB7"), True, ("right",)),
        (TWO.replace('"left"', '"links"'), True, ("left",)),
        (TWO + RELAY.format(1), True, ()),
    ],
)
def test_only_what_differs_restarts_and_only_a_changed_projector_cools(
    tmp_path: Path, after: str, restarts: bool, lamps: tuple[str, ...]
) -> None:
    found = between(TWO, after)
    assert (found.restarts, found.lamps) == (restarts, lamps)
    assert bool(found.warning(tmp_path)) is restarts
    assert all(name in found.warning(tmp_path) for name in lamps)


def test_a_projector_whose_mains_change_cools() -> None:
    assert between(TWO + RELAY.format(1), TWO + RELAY.format(2)).lamps == ("right",)
    assert between(TWO + RELAY.format(1), TWO).lamps == ("right",)


def test_the_last_good_settings_stand_in_for_damaged_ones_which_stay_as_they_are(tmp_path: Path) -> None:
    stage = vase(tmp_path / "stage")
    (stage / "stage.toml").write_text(TEXT.replace("The vase", "The bust"))
    GoodSettings().keep(check_stage(stage))
    (stage / "stage.toml").write_text(TEXT + "\n[camra]\n")
    with pytest.raises(UsageError) as damaged:
        check_stage(stage)
    checked, problem = last_good(stage, damaged.value)
    assert checked.stage.tables.stage.name == "The bust"
    assert checked.stage.folder == stage.resolve()
    assert "camra" in problem.text
    assert "line" in problem.text
    assert "[camra]" in (stage / "stage.toml").read_text()
    (stage / GOOD).unlink()
    with pytest.raises(UsageError) as still:
        last_good(stage, damaged.value)
    assert still.value is damaged.value


def test_hours_that_were_cut_off_are_damage_too(tmp_path: Path) -> None:
    stage = vase(tmp_path / "stage")
    hours = '\n[[schedule.hours]]\nday = "sun"\nopens = "16:11"\ncloses = "18:55"\n'
    (stage / "stage.toml").write_text(TEXT + hours)
    GoodSettings().keep(settings.checked_settings(stage))
    (stage / "stage.toml").write_text((TEXT + hours).partition("closes")[0])
    with pytest.raises(UsageError) as damaged:
        settings.checked_settings(stage)
    checked, problem = last_good(stage, damaged.value)
    assert checked.stage.tables.schedule.hours[0].closes == "18:55"
    assert "16:11" in problem.text


def test_good_settings_that_a_full_disk_did_not_take_are_kept_once_it_has_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage, good = vase(tmp_path / "stage"), GoodSettings()
    (stage / "stage.toml").write_text(TEXT)

    def full(path: Path, content: bytes, mode: int) -> None:
        raise WorkError("no-space", what="The disk is full.", remedy="Free some space.")

    with monkeypatch.context() as patched:
        patched.setattr(settings, "write_atomically", full)
        good.keep(check_stage(stage))
        good.step()
        assert not (stage / GOOD).exists()
    (stage / "stage.toml").write_text("damaged since")
    good.step()
    assert (stage / GOOD).read_text() == TEXT


def test_a_stage_that_the_panel_sets_up_trusts_its_own_key(tmp_path: Path) -> None:
    stage = tmp_path / "stage"
    stage.mkdir()
    StageKiosk(stage).save_settings(TEXT)
    checked = check_stage(stage)
    assert len(checked.stage.tables.bundle.trusted_keys) == 1
    assert signing_key(checked) is not None, "its own bundles are not refused"
    StageKiosk(stage).save_settings(TEXT)
    assert load_stage(stage).tables.bundle.trusted_keys == (), "later only what is written counts"
