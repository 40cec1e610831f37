"""When inventories are taken, and what the page and the command say of them."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import pytest
from typer.testing import CliRunner

from controller.__main__ import application
from controller.kiosk.api.folder import FolderKiosk
from controller.kiosk.changes import inventory
from controller.kiosk.changes.inventory import Fact, Inventory
from controller.kiosk.changes.watch import COMPLETE_S, InventoryWatch, newest_good, since_good
from controller.kiosk.store.event_log import EventLog
from tests.controller.kiosk.vase import graded_run, vase

NOON_S = datetime(2026, 5, 4, 20, 0).astimezone().timestamp()
NIGHT_S = datetime(2026, 5, 5, 4, 0).astimezone().timestamp()
FIRST, SECOND, BAD = "20260504-100000-calibrate", "20260505-100000-calibrate", "20260506-100000-calibrate"


class Days:
    """A stage, its clock, and what an inventory finds."""

    def __init__(self, folder: Path) -> None:
        self.stage = vase(folder / "stage")
        self.log = EventLog(self.stage / EventLog.FILE, durable=False)
        self.now_s, self.busy, self.taken = NOON_S, False, 0
        self.facts = {"kernel": "6.1", "keystone": None}
        self.watch = InventoryWatch(
            self.stage, self.take, lambda: 5.0, self.log, busy=lambda: self.busy, wall=lambda: self.now_s
        )

    def take(self, run: str = "") -> Inventory:
        self.taken += 1
        facts = tuple(Fact(kind, "", value) for kind, value in self.facts.items())
        return Inventory(self.now_s, run, facts)

    def step(self, after_s: float = 0.0) -> None:
        self.now_s += after_s
        self.watch.step()

    @property
    def codes(self) -> list[str]:
        return [row.code for row in self.log.after(0)]

    @property
    def said(self) -> list[str]:
        return [one.sentence for one in since_good(self.stage, self.take()).changes]


@pytest.fixture
def days(tmp_path: Path) -> Days:
    return Days(tmp_path)


def test_one_is_taken_after_each_good_grade_and_none_after_a_bad_one(days: Days) -> None:
    days.step()
    assert since_good(days.stage, days.take()).good_unix_s is None
    graded_run(days.stage, FIRST, {"left": 0.01})
    days.busy = True
    days.step()
    assert inventory.last_good(days.stage) is None, "a job has the camera"
    days.busy = False
    days.step()
    days.facts["kernel"] = "6.2"
    graded_run(days.stage, BAD, {"left": 0.5})
    days.step(60)
    assert since_good(days.stage, days.take()).run == FIRST
    assert days.said == ["The kernel was 6.1, and is now 6.2."]
    shutil.rmtree(days.stage / "runs" / BAD)
    graded_run(days.stage, SECOND, {"left": 0.012})
    days.step(60)
    assert since_good(days.stage, days.take()).run == SECOND
    assert days.said == []
    assert days.codes == ["inventory-taken", "inventory-taken"]


def test_a_check_that_found_nothing_is_a_good_day_too(days: Days) -> None:
    graded_run(days.stage, FIRST, {"left": 0.01})
    check = days.stage / "runs" / "20260505-033000-drift"
    check.mkdir()
    (check / "drift.json").write_text(json.dumps({"advice": "nothing"}))
    assert newest_good(days.stage, 5.0) == check.name
    (check / "drift.json").write_text(json.dumps({"advice": "quick"}))
    assert newest_good(days.stage, 5.0) == ""
    (check / "drift.json").write_text("{")
    assert newest_good(days.stage, 5.0) == FIRST, "one that was cut off says nothing"


def test_what_a_dark_projector_did_not_tell_is_added_when_it_does(days: Days) -> None:
    graded_run(days.stage, FIRST, {"left": 0.01})
    days.step()
    days.facts["keystone"] = "128"
    days.step(1)
    days.facts["keystone"] = "140"
    assert days.said == ["The keystone of projector was 128, and is now 140."]
    taken = days.taken
    days.step(COMPLETE_S + 1)
    assert days.taken == taken, "everything is known now"


def test_every_night_has_one_and_a_change_is_told_once(days: Days) -> None:
    graded_run(days.stage, FIRST, {"left": 0.01})
    days.step()
    for night in range(4):
        days.now_s = NIGHT_S + night * 86_400
        days.facts["kernel"] = "6.1" if night < 2 else "6.2"
        days.step()
        days.step()
    told = [row for row in days.log.after(0) if row.code == "stage-changed"]
    assert len(told) == 1
    assert told[0].level == "warning"
    assert "The kernel was 6.1, and is now 6.2." in told[0].text
    (change,) = since_good(days.stage, days.take()).changes
    assert change.since_unix_s == NIGHT_S + 2 * 86_400
    assert len(list((days.stage / inventory.FOLDER).glob("night-*.json"))) == 4


def test_a_night_that_can_not_be_written_is_told_once_and_taken_later(days: Days) -> None:
    days.now_s = NIGHT_S
    (days.stage / inventory.FOLDER).parent.mkdir(exist_ok=True)
    (days.stage / inventory.FOLDER).write_text("in the way")
    for _ in range(5):
        days.step(COMPLETE_S + 1)
    assert days.codes == ["inventory-not-kept"]
    assert days.taken == 5
    days.step(1)
    assert days.taken == 5
    (days.stage / inventory.FOLDER).unlink()
    days.step(COMPLETE_S + 1)
    days.step(COMPLETE_S + 1)
    assert (days.codes, days.taken) == (["inventory-not-kept"], 6)
    assert len(list((days.stage / inventory.FOLDER).glob("night-*.json"))) == 1


@pytest.mark.parametrize("damage", ["{", "[]", '{"facts": 3}', "\udcff"])
def test_a_damaged_inventory_is_as_none(days: Days, damage: str) -> None:
    graded_run(days.stage, FIRST, {"left": 0.01})
    days.step()
    path = days.stage / inventory.FOLDER / "good.json"
    path.write_bytes(damage.encode("utf-8", "surrogateescape"))
    assert inventory.last_good(days.stage) is None
    days.step(1)
    assert inventory.last_good(days.stage) is not None, "it is taken again"


def test_the_command_names_a_change_of_the_settings_while_no_kiosk_runs(days: Days) -> None:
    nothing = CliRunner().invoke(application(), ["kiosk", "changes", str(days.stage)])
    assert "There was no good day yet" in nothing.stdout
    kiosk = FolderKiosk(days.stage)
    assert kiosk.changes().good_unix_s is None
    from controller.config import load_stage
    from controller.kiosk.changes.machine import Machine
    from controller.kiosk.changes.watch import take

    good = take(days.stage, load_stage(days.stage).tables, (Fact("camera body", "", "EOS R5"),), Machine(), FIRST)
    inventory.keep_good(days.stage, replace(good, taken_unix_s=NOON_S))
    text = (days.stage / "stage.toml").read_text()
    (days.stage / "stage.toml").write_text(text.replace("iso = 100", "iso = 200"))
    shown = CliRunner().invoke(application(), ["kiosk", "changes", str(days.stage)])
    assert shown.exit_code == 0
    assert f"The last good day was 2026-05-04 20:00 ({FIRST})." in shown.stdout
    assert "In stage.toml, camera.iso was 100, and is now 200." in shown.stdout
    answer = json.loads(CliRunner().invoke(application(), ["kiosk", "changes", str(days.stage), "--json"]).stdout)
    assert [one["kind"] for one in answer["result"]["changes"]] == ["settings"]
    assert answer["result"]["unknown"] == ["The camera"]
