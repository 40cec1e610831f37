"""All appearances in turn: by themselves, by the schedule, when somebody chooses, and without a projector."""

from __future__ import annotations

from pathlib import Path

import pytest

from controller.core.errors import UsageError, WorkError
from controller.kiosk.decide.interfaces import BLACK, Showing
from controller.kiosk.schedule import WEEKDAYS, check_schedule
from controller.kiosk.values import IN_TURN, Schedule, ScheduleRow
from controller.run.state_machine import State
from tests.controller.kiosk.model import BUNDLE, Kiosk

TURNS = (("shine", 15.0, 1.0), ("marble", 20.0, 2.0))
ALL = Showing(BUNDLE, "shine", TURNS)


@pytest.fixture
def kiosk(tmp_path: Path) -> Kiosk:
    made = Kiosk(tmp_path)
    made.bundles.turns = TURNS
    return made


def test_a_bundles_playlist_is_shown_until_somebody_chooses_and_again_when_asked(kiosk: Kiosk) -> None:
    kiosk.run_until(State.PLAYING)
    assert kiosk.player.want == ALL
    kiosk.reconciler.choose("marble")
    kiosk.run(2)
    assert kiosk.player.want == Showing(BUNDLE, "marble")
    assert kiosk.player.want.fade_s == 2.0, "as the playlist says for it"
    kiosk.log.close()
    kiosk.boot()
    kiosk.run_until(State.PLAYING)
    assert kiosk.player.want == Showing(BUNDLE, "marble"), "also after a restart"
    kiosk.reconciler.choose(IN_TURN)
    kiosk.run(2)
    assert kiosk.player.want == ALL


def test_the_schedule_says_when_one_is_shown_and_when_all_are(kiosk: Kiosk) -> None:
    rows = [(day, hours) for day in WEEKDAYS for hours in (("00:00", "12:00", "marble"), ("12:00", "00:00", IN_TURN))]
    kiosk.schedule = Schedule("UTC", tuple(ScheduleRow(day, *hours) for day, hours in rows))
    check_schedule(kiosk.schedule, ("shine", "marble"))
    with pytest.raises(UsageError) as refused:
        check_schedule(Schedule("UTC", (ScheduleRow("mon", "10:00", "12:00", "glass"),)), ("shine", "marble"))
    assert IN_TURN in refused.value.remedy
    kiosk.run_until(State.PLAYING)
    seen = []
    for _ in range(5):
        seen.append(kiosk.player.want)
        kiosk.wall_offset_s += 6 * 3600.0
        kiosk.run(5)
    assert set(seen) == {ALL, Showing(BUNDLE, "marble")}


def test_without_a_projector_all_are_shown_in_turn_for_the_others(kiosk: Kiosk) -> None:
    kiosk.run_until(State.PLAYING)
    other = Path("bundles-without/left/one.vel")
    kiosk.bundles.beside[frozenset({"left"})] = other
    kiosk.lamps["left"].burst()
    kiosk.run_until(State.DEGRADED)
    kiosk.run(2)
    assert kiosk.player.want == Showing(other, "shine", TURNS)


def test_a_playlist_of_one_is_that_one(kiosk: Kiosk) -> None:
    kiosk.bundles.turns = TURNS[1:]
    kiosk.run_until(State.PLAYING)
    assert kiosk.player.want == Showing(BUNDLE, "marble")


def test_the_next_one_is_where_the_list_goes_on_and_a_pause_holds_it(kiosk: Kiosk) -> None:
    kiosk.run_until(State.PLAYING)
    kiosk.run(2)
    kiosk.reconciler.next(4.0)
    kiosk.run(1)
    turned = Showing(BUNDLE, "marble", (TURNS[1], TURNS[0]))
    assert kiosk.player.want == turned
    assert kiosk.player.want.fade_s == 4.0
    kiosk.run(2)
    assert kiosk.player.want.fade_s == 2.0, "the fade was for this change alone"
    kiosk.reconciler.pause(True)
    kiosk.run(2)
    assert kiosk.player.want == Showing(BUNDLE, "marble")
    kiosk.reconciler.next()
    kiosk.run(2)
    assert kiosk.player.want == Showing(BUNDLE, "shine")
    kiosk.reconciler.pause(False)
    kiosk.run(2)
    assert kiosk.player.want == ALL


def test_a_list_continues_after_black_where_it_was(kiosk: Kiosk) -> None:
    kiosk.run_until(State.PLAYING)
    kiosk.reconciler.next()
    kiosk.run(2)
    kiosk.reconciler.black(True)
    kiosk.run(2)
    kiosk.reconciler.black(False)
    kiosk.run(2)
    assert kiosk.player.want == Showing(BUNDLE, "marble", (TURNS[1], TURNS[0]))


def test_black_and_brightness_last_over_a_restart_and_end_when_the_stage_closes(kiosk: Kiosk) -> None:
    kiosk.run_until(State.PLAYING)
    kiosk.run(2)
    kiosk.reconciler.brighten(0.4)
    kiosk.run(2)
    assert kiosk.player.want == Showing(BUNDLE, "shine", TURNS, brightness=0.4)
    kiosk.reconciler.black(True, 3.0)
    kiosk.run(2)
    assert kiosk.player.want == BLACK
    assert kiosk.reconciler.machine.state is State.PLAYING, "the lamps stay lit"
    kiosk.log.close()
    kiosk.boot()
    kiosk.run_until(State.PLAYING)
    kiosk.run(2)
    assert kiosk.player.want == BLACK
    kiosk.reconciler.black(False)
    kiosk.run(2)
    assert kiosk.player.want == Showing(BUNDLE, "shine", TURNS, brightness=0.4)
    kiosk.reconciler.black(True)
    kiosk.reconciler.shut()
    kiosk.run_until(State.OFF)
    with pytest.raises(WorkError, match="closed"):
        kiosk.reconciler.next()
    kiosk.reconciler.open()
    kiosk.run_until(State.PLAYING)
    kiosk.run(2)
    assert kiosk.player.want == ALL
