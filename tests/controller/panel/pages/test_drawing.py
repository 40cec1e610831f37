"""Times and words of the pages; the escaping of every page has tests of its own."""

from __future__ import annotations

import math

import pytest

from controller.kiosk.state import BundleIdentity, DeviceRow, EventRow, Job, JobStep, KioskState, NextEvent
from controller.panel.pages.drawing import EVENTS_SHOWN, STATES, Drawing
from controller.run.state_machine import State

SUMMER = 1_782_900_000.0
"""2026-07-01 10:00 UTC."""


def state(**values: object) -> KioskState:
    fields: dict[str, object] = {
        "revision": 1,
        "stage": "vase",
        "state": "playing",
        "reason": "",
        "since_unix_s": SUMMER,
    }
    return KioskState(**(fields | values))  # type: ignore[arg-type]


def row(number: int, unix_s: float = SUMMER) -> EventRow:
    return EventRow(number, unix_s, "info", f"event {number}.")


def test_every_state_of_the_machine_has_words() -> None:
    assert {one.value for one in State} == set(STATES)
    parts = Drawing().parts(state(state="unheard of"), [])
    assert "unheard of" in parts["top"]


def test_each_cause_has_one_line_with_its_advice_once_and_the_disk_comes_first() -> None:
    cable, full = "Check its cable.", "Remove files."
    rows = (
        DeviceRow("camera", "camera", "ptp", (), "It is not connected.", "Plug it in."),
        DeviceRow("left", "projector", "serial", (), "It does not answer.", cable),
        DeviceRow("middle", "projector", "serial", (), "The lamp failed.", "Replace the lamp."),
        DeviceRow("right", "projector", "serial", (), "It does not answer.", cable),
        DeviceRow("disk", "disk", "", (), "The disk is full.", full),
        DeviceRow("display", "display", "player"),
    )
    shown = state(devices=rows, state="degraded", reason=f"left: It does not answer. {cable}", playing="wood")
    top = Drawing().parts(shown, [])["top"]
    assert [top.count(text) for text in (cable, full, "It does not answer.")] == [1, 1, 1]
    places = [top.index(text) for text in ("disk:", "left, right:", "middle:", "camera:")]
    assert places == sorted(places)
    assert cable not in Drawing().parts(shown, [])["devices"]


def test_nothing_is_said_to_play_while_nothing_does() -> None:
    assert "Nothing plays" in Drawing().parts(state(state="degraded", playing=""), [])["top"]
    assert "Playing with problems" in Drawing().parts(state(state="degraded", playing="wood"), [])["top"]
    assert "Nothing plays" not in Drawing().parts(state(state="degraded", black=True), [])["top"]


def test_times_are_those_of_the_stage() -> None:
    drawing = Drawing()
    assert "Wed 01 Jul 2026, 10:00" in drawing.parts(state(), [])["top"]
    drawing.use_zone("Europe/Vienna")
    assert "Wed 01 Jul 2026, 12:00" in drawing.parts(state(), [])["top"]
    for name in ("Nowhere/At_All", "", "../etc/passwd", "\x00", "Europe"):
        drawing.use_zone("Europe/Vienna")
        drawing.use_zone(name)
        assert "10:00" in drawing.parts(state(), [])["top"]


@pytest.mark.parametrize("moment", [float(2**53), -1e18, math.nan, math.inf, -math.inf, 1e300])
def test_a_time_that_can_be_none_takes_no_page_away(moment: float) -> None:
    shown = state(
        since_unix_s=moment, bundle=BundleIdentity(1, "ab" * 32, moment), next_event=NextEvent("opens", moment)
    )
    parts = Drawing().parts(shown, [row(1, moment), row(2)])
    assert [name for name in ("top", "next", "events") if "unknown time" not in parts[name]] == []
    assert "event 2." in parts["events"]


def test_the_newest_events_come_first_and_no_more_than_people_read() -> None:
    drawn = Drawing().parts(state(), [row(number) for number in range(1, EVENTS_SHOWN + 11)])["events"]
    assert drawn.index("event 210.") < drawn.index("event 11.")
    assert "event 10." not in drawn
    assert drawn.count("<li") == EVENTS_SHOWN


def test_a_job_shows_its_step_and_then_what_came_of_it() -> None:
    steps = (JobStep("Power", 1.0), JobStep("Decode", 0.256))
    going = Drawing().parts(state(job=Job(1, "Full", steps, left_s=125.0)), [])["job"]
    assert "2 min 05 s left" in going
    assert "26 %" in going
    assert going.count('aria-current="step"') == 1
    failed = Drawing().parts(state(job=Job(1, "Full", steps, ended=True, failed=True, outcome="No light.")), [])["job"]
    assert "No light." in failed
    assert "<progress" not in failed
