"""What every kiosk answers and refuses, operation by operation: for the real one, and for the double of the panel."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import jsonschema_rs
import pytest
from PIL import Image

from controller.core.errors import VelaturaError
from controller.kiosk.interface import Kiosk
from controller.kiosk.operations.dispatch import local_values
from controller.kiosk.operations.operation import Answer
from controller.kiosk.operations.table import AT_SOCKET
from controller.kiosk.state import EventRow, Job, KioskState
from controller.kiosk.values import (
    Aiming,
    Appearance,
    Changes,
    Comparison,
    Finding,
    FoundDevice,
    LampDay,
    Results,
    Scene,
    Schedule,
    TriedDevice,
)
from controller.panel.answers import plain
from controller.panel.api import answer_schemas
from controller.stage.blender.job import BUILTIN
from tests.controller.kiosk import vase

PLAYING, OTHER, RUN = "marble", "glass", "20260101-100000-calibrate"
"""Every kiosk of these tests plays PLAYING, has OTHER installed as well, and the finished calibration RUN."""
TEXT = f"{vase.TEXT}\n[bundle]\nallow_unsigned = true\n"
NEEDS_A_CALIBRATION = {
    "computed-picture", "computed-preview", "feasibility", "reach", "reach-picture", "scene-reach-picture", "view",
    "laid-mesh", "laid-mesh-picture",
}  # fmt: skip
"""What no stage of these tests can do: tests/end_to_end/test_kiosk_targets.py asks it of a calibrated one."""


class Stage(Protocol):
    """A kiosk with the knobs of a test."""

    kiosk: Kiosk
    folder: Path

    def settle(self) -> None:
        """Let what was asked for show in the kiosk's state."""


Check = Callable[[Any, Stage], object]


@dataclass(frozen=True)
class Case:
    """``sent`` to the operation; ``code`` of the refusal, or empty, and then ``holds`` must be true of the answer.

    ``first``: operations that are asked before, with what they are sent
    """

    op: str
    sent: dict[str, Any] = field(default_factory=dict)
    code: str = ""
    holds: Check = lambda answer, stage: answer is None
    first: tuple[tuple[str, dict[str, Any]], ...] = ()

    def __str__(self) -> str:
        return "-".join([self.op, *(str(value)[:20] for value in self.sent.values()), self.code or "ok"])


def every(kind: type, *, least: int = 0) -> Check:
    return lambda answer, stage: len(answer) >= least and all(type(one) is kind for one in answer)


def a_file(answer: Any, stage: Stage) -> bool:
    return isinstance(answer, Path) and answer.is_file()


def perhaps_a_file(answer: Any, stage: Stage) -> bool:
    return answer is None or a_file(answer, stage)


def a_job(answer: Any, stage: Stage) -> bool:
    return isinstance(answer, Job) and answer.number > 0 and not answer.ended and bool(answer.name)


def names_of(rows: Sequence[Appearance]) -> list[str]:
    return [row.name for row in rows]


def hours(**changes: Any) -> dict[str, Any]:
    row = {"day": "mon", "opens": "10:00", "closes": "18:00", "appearance": OTHER}
    return {"time_zone": "Europe/Vienna", "drift_check": "03:00", "rows": [row | changes]}


def overlapping() -> dict[str, Any]:
    rows = [{"day": day, "opens": opens, "closes": "18:00"} for day, opens in (("mon-fri", "10:00"), ("Tue", "17:59"))]
    return {"time_zone": "Europe/Vienna", "rows": rows}


def days_of(stage: Stage) -> list[str]:
    return [row.day for row in stage.kiosk.schedule().rows]


FULL = ("recalibrate", {"kind": "full"})
"""Work that is not done yet when the next question comes."""
TOML = TEXT.replace("iso = 100", "iso = 200")

CASES: tuple[Case, ...] = (
    Case("state", holds=lambda state, _: type(state) is KioskState and state.playing == PLAYING),
    Case("events", holds=lambda rows, _: every(EventRow, least=1)(rows, _) and ascending(rows)),
    Case("events", {"after": 10**9}, holds=lambda rows, _: list(rows) == []),
    Case("events", {"level": "error"}, holds=lambda rows, _: all(row.level == "error" for row in rows)),
    Case("start"),
    Case("stop"),
    Case("play", {"name": OTHER}),
    Case("play", {"name": "no such"}, "appearance-unknown"),
    Case("play", {"name": OTHER, "fade_s": 2.5}),
    Case("play", {"name": OTHER, "fade_s": -1}, "field-wrong"),
    Case("rotate"),
    Case("next", first=(("play", {"name": PLAYING}),)),
    Case("next", {}, "nothing-plays", first=(("stop", {}),)),
    Case("black", {"on": True, "fade_s": 1}, first=(("start", {}),)),
    Case("black", {"on": True}, "nothing-plays", first=(("stop", {}),)),
    Case("black", {"on": False}, first=(("stop", {}),)),
    Case("pause", {"on": True}, first=(("play", {"name": PLAYING}),)),
    Case("pause", {"on": True}, "nothing-plays", first=(("stop", {}),)),
    Case("brightness", {"percent": 40}, first=(("play", {"name": PLAYING}),)),
    Case("brightness", {"percent": 101}, "field-wrong"),
    Case("brightness", {"percent": 40}, "nothing-plays", first=(("stop", {}),)),
    Case("identify", {"on": True}, holds=lambda _, stage: shows_names(stage)),
    Case("camera", holds=lambda jpeg, _: jpeg is None or jpeg.startswith(b"\xff\xd8")),
    Case("photograph", holds=lambda jpeg, _: jpeg is None),
    Case("photograph", holds=lambda jpeg, _: jpeg is None or jpeg.startswith(b"\xff\xd8"), first=(FULL,)),
    Case("lamp-history", holds=every(LampDay)),
    Case("recalibrate", {"kind": "full"}, holds=a_job),
    Case("recalibrate", {"kind": "quick"}, holds=a_job),
    Case("recalibrate", {"kind": "full", "projector": "left"}, holds=a_job),
    Case("recalibrate", {"kind": "full", "projector": "camera"}, "projector-unknown"),
    Case("recalibrate", {"kind": "quick"}, "busy", first=(FULL,)),
    Case("cancel", {}, "nothing-to-cancel"),
    Case("cancel", first=(FULL,)),
    Case("job", {"number": 10**9}, "job-given-up"),
    Case("compute", {"name": "wood", "target": "target.png"}, holds=a_job),
    Case("compute", {"name": OTHER, "target": "target.png"}, holds=a_job),
    Case("compute", {"name": "wood", "target": "target.png", "fit": "crop"}, holds=a_job),
    Case("compute", {"name": "wood", "target": "target.png", "fit": "stretch"}, "field-wrong"),
    Case("compute", {"name": "wood", "target": "BACKUP"}, "target-unreadable"),
    Case("compute", {"name": "Grün_Ötzi", "target": "target.png"}, holds=a_job),
    Case("compute", {"name": "two words", "target": "target.png"}, "field-wrong"),
    Case("compute", {"name": "wood", "target": "target.png"}, "busy", first=(FULL,)),
    Case("scenes", holds=lambda rows, _: every(Scene)(rows, _) and [row.name for row in rows][:4] == list(BUILTIN)),
    Case("scene-picture", {"scene": "gold"}, holds=a_file),
    Case("scene-picture", {"scene": "no such"}, holds=lambda found, _: found is None),
    Case("scene-picture", {"scene": "../stage.toml"}, "field-wrong"),
    Case("meshes", holds=lambda names, _: list(names) == ["bust.glb"]),
    Case("mesh-picture", {"mesh": "bust.glb", "side": 9}, holds=a_file),
    Case("mesh-picture", {"mesh": "no such.glb", "side": 0}, "mesh-unknown"),
    Case("mesh-picture", {"mesh": "../stage.toml", "side": 0}, "field-wrong"),
    Case("mesh-picture", {"mesh": "bust.glb", "side": 32}, "field-wrong"),
    Case("lay-mesh", {"mesh": "no such.glb"}, "mesh-unknown"),
    Case("scene-reach", {"scene": "no such"}, "scene-unknown"),
    Case("compute-scene", {"name": "golden", "scene": "gold"}, holds=a_job),
    Case("compute-scene", {"name": "golden", "scene": "no such"}, "scene-unknown"),
    Case("compute-scene", {"name": "two words", "scene": "gold"}, "field-wrong"),
    Case("compute-scene", {"name": "golden", "scene": "gold"}, "busy", first=(FULL,)),
    Case("compare", holds=a_job),
    Case("compare", {"name": OTHER}, holds=a_job),
    Case("compare", {"name": "no such"}, "appearance-unknown"),
    Case("compare", {}, "busy", first=(FULL,)),
    Case("test-shots", holds=a_job),
    Case("test-shots", {}, "busy", first=(FULL,)),
    Case("appearances", holds=lambda rows, _: every(Appearance)(rows, _) and names_of(rows)[:2] == [PLAYING, OTHER]
         and [row.playing for row in rows][:2] == [True, False]),
    Case("preview", {"name": PLAYING}, holds=perhaps_a_file),
    Case("preview", {"name": "no such"}),
    Case("projector-picture", {"name": PLAYING, "projector": "left"}, holds=a_file),
    Case("projector-picture", {"name": PLAYING, "projector": "camera"}, holds=lambda found, _: found is None),
    Case("projector-picture", {"name": "no such", "projector": "left"}, "appearance-unknown"),
    Case("remove-appearance", {"name": OTHER}),
    Case("remove-appearance", {"name": PLAYING}, "appearance-in-use"),
    Case("remove-appearance", {"name": OTHER}, "appearance-in-use", first=(("set-schedule", hours()),)),
    Case("remove-appearance", {"name": "no such"}, "appearance-unknown"),
    Case("remove-appearance", {"name": OTHER}, "busy", first=(FULL,)),
    Case("comparisons", holds=every(Comparison)),
    Case("comparison-picture", {"name": "no such", "picture": "error"}),
    Case("runs", holds=lambda runs, _: RUN in runs),
    Case("results", {"run": RUN}, holds=lambda found, _: type(found) is Results and found.run == RUN),
    Case("results", {"run": "20200101-100000-calibrate"}, "run-unknown"),
    Case("run-picture", {"run": RUN, "picture": "error"}, holds=perhaps_a_file),
    Case("run-picture", {"run": "nothing", "picture": "error"}, "run-unknown"),
    Case("report", {"run": "nothing"}, "run-unknown"),
    Case("aiming", holds=lambda found, _: type(found) is Aiming),
    Case("aiming-picture", holds=perhaps_a_file),
    Case("schedule", holds=lambda found, _: type(found) is Schedule),
    Case("seen", {"number": 10**9}, holds=lambda _, stage: stage.kiosk.snapshot().failures == ()),
    Case("set-schedule", hours(), holds=lambda _, stage: stage.kiosk.schedule().rows[0].appearance == OTHER),
    Case("set-schedule", hours(day="Monday and sat - sun"),
         holds=lambda _, stage: days_of(stage) == ["mon", "sat", "sun"]),
    Case("set-schedule", hours(day="someday"), "schedule-wrong"),
    Case("set-schedule", overlapping(), "schedule-overlap"),
    Case("effect-of-schedule", hours(), holds=lambda told, _: isinstance(told, str)),
    Case("effect-of-schedule", overlapping(), "schedule-overlap"),
    Case("set-schedule", hours(appearance="no such"), "schedule-wrong"),
    Case("set-schedule", hours(day="2026-02-31"), "schedule-wrong"),
    Case("set-schedule", hours(closes=""), "schedule-wrong"),
    Case("set-schedule", hours() | {"time_zone": "Europe/Atlantis"}, "schedule-zone"),
    Case("settings", holds=lambda text, _: text.strip() == TEXT.strip()),
    Case("check-settings", {"text": TOML}, holds=lambda _, stage: stage.kiosk.settings().strip() == TEXT.strip()),
    Case("check-settings", {"text": "[stage"}, "stage-syntax"),
    Case("check-settings", {"text": TEXT.replace("iso = 100", 'iso = "high"')}, "stage-key-type"),
    Case("check-settings", {"text": '[stage]\nname = "alone"\n'}, "stage-key-missing"),
    Case("effect-of-settings", {"text": TEXT}, holds=lambda told, _: told == ""),
    Case("effect-of-settings", {"text": "[stage"}, "stage-syntax"),
    Case("save-settings", {"text": TOML}, holds=lambda _, stage: stage.kiosk.settings() == TOML),
    Case("save-settings", {"text": "[stage"}, "stage-syntax"),
    Case("save-settings", {"text": TOML}, "busy", first=(FULL,)),
    Case("changes", holds=lambda found, _: type(found) is Changes),
    Case("doctor", holds=every(Finding)),
    Case("backup", holds=a_file),
    Case("restore", {"backup": "BACKUP"}, holds=lambda _, stage: stage.kiosk.settings().strip() == TEXT.strip(),
         first=(("save-settings", {"text": TOML}),)),
    Case("restore", {"backup": "target.png"}, "not-a-backup"),
    Case("restore", {"backup": "BACKUP"}, "busy", first=(FULL,)),
    Case("test-backup", code="backup-nowhere"),
    Case("test-alerts", {}, "alerts-none"),
    Case("diagnostics", holds=a_file),
    Case("find-devices", holds=every(FoundDevice)),
    Case("try-device", {"key": "nothing"}, holds=lambda tried, _: type(tried) is TriedDevice and not tried.works),
)  # fmt: skip


def ascending(rows: Sequence[EventRow]) -> bool:
    numbers = [row.number for row in rows]
    return numbers == sorted(set(numbers))


def shows_names(stage: Stage) -> bool:
    """At once: the person who asked looks at the next page."""
    return stage.kiosk.snapshot().identifying


def ask(stage: Stage, op: str, sent: dict[str, Any]) -> Any:
    operation = next(one for one in AT_SOCKET if one.name == op)
    return operation.function(stage.kiosk, **local_values(operation, sent))


class Contract:
    """For a class with a fixture ``stage``, whose kiosk works on ``stage.folder`` or keeps its files there."""

    @pytest.mark.parametrize("case", CASES, ids=str)
    def test_it_answers_and_refuses_like_every_kiosk(self, stage: Stage, case: Case) -> None:
        target = stage.folder / "target.png"
        Image.new("RGB", (60, 40), (200, 90, 30)).save(target)
        # Before anything runs: the double and the real one need their own kind of file.
        paths = {"target.png": str(target), "BACKUP": str(stage.kiosk.backup())}
        sent = {name: paths.get(value, value) if isinstance(value, str) else value for name, value in case.sent.items()}
        for op, before in case.first:
            ask(stage, op, before)
        if case.code:
            with pytest.raises(VelaturaError) as caught:
                ask(stage, case.op, sent)
            assert (caught.value.code, bool(caught.value.remedy)) == (case.code, True)
        else:
            answer = ask(stage, case.op, sent)
            assert case.holds(answer, stage)
            assert schema_errors(case.op, answer) == []

    def test_a_job_that_was_begun_is_known_or_waits(self, stage: Stage) -> None:
        job = ask(stage, *FULL)
        known = ask(stage, "job", {"number": job.number})
        assert known is None or (known.number, known.ended) == (job.number, False)
        stage.kiosk.cancel()

    def test_a_subscriber_hears_of_a_change_until_it_leaves(self, stage: Stage) -> None:
        heard: list[int] = []
        leave = stage.kiosk.subscribe(lambda: heard.append(1))
        assert shows_names_after(stage)
        assert heard
        leave()
        count = len(heard)
        stage.kiosk.identify(False)
        stage.settle()
        assert len(heard) == count

    def test_the_state_says_nothing_that_is_no_number(self, stage: Stage) -> None:
        state = stage.kiosk.snapshot()
        assert math.isfinite(state.since_unix_s)
        assert all(math.isfinite(lamp.hours) for lamp in state.lamps)

    def test_black_shows_nothing_and_has_ways_back(self, stage: Stage) -> None:
        def after(op: str, **sent: Any) -> tuple[bool, bool, str]:
            ask(stage, op, sent)
            stage.settle()
            now = stage.kiosk.snapshot()
            return now.black, now.paused, now.playing

        assert after("play", name=PLAYING) == (False, False, PLAYING)
        assert after("black", on=True) == (True, False, "")
        assert after("black", on=True) == (True, False, "")
        assert after("black", on=False) == (False, False, PLAYING)
        after("black", on=True)
        assert after("next") == (False, False, OTHER)
        after("black", on=True)
        assert after("pause", on=True) == (True, True, "")
        assert after("black", on=False) == (False, True, OTHER)
        after("black", on=True)
        assert after("pause", on=False) == (True, False, "")
        assert after("brightness", percent=50) == (True, False, "")
        assert after("play", name=PLAYING) == (False, False, PLAYING)
        after("black", on=True)
        assert after("rotate")[0] is False


def shows_names_after(stage: Stage) -> bool:
    stage.kiosk.identify(True)
    return shows_names(stage)


def schema_errors(op: str, answer: Any) -> list[str]:
    """What an answer has that the API's document does not say of it."""
    operation = next(one for one in AT_SOCKET if one.name == op)
    if operation.answer is not Answer.VALUE:
        return []
    answered, objects = answer_schemas([operation])
    schema = answered[op] | {"components": {"schemas": objects}}
    # An object may have more than a document says, so that a later version can; here, nothing is more.
    for component in objects.values():
        component["additionalProperties"] = False
    return [error.message for error in jsonschema_rs.validator_for(schema).iter_errors(plain(operation, answer))]


def test_every_operation_of_a_kiosk_is_in_the_contract() -> None:
    declared = {one.name for one in AT_SOCKET if one.holder == "kiosk"}
    assert {case.op for case in CASES} == declared - NEEDS_A_CALIBRATION
