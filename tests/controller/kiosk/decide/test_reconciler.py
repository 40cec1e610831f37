from __future__ import annotations

from pathlib import Path
from random import Random

import pytest

from controller.core.errors import WorkError
from controller.kiosk.decide.interfaces import BLACK, Request, Showing
from controller.run.state_machine import State
from hal.notices import Level, Notice
from hal.values import Power, ProjectorStatus
from tests.controller.kiosk.model import BUNDLE, NAMES, RULES, STEP_S, Kiosk


@pytest.fixture
def kiosk(tmp_path: Path) -> Kiosk:
    return Kiosk(tmp_path)


def test_boots_from_nothing_to_playing(kiosk: Kiosk) -> None:
    kiosk.run_until(State.PLAYING)
    assert kiosk.lit == list(NAMES)
    assert kiosk.player.view.shown == Showing(BUNDLE, "shine")
    assert not kiosk.sins


def test_pictures_are_on_the_outputs_before_any_lamp_has_answered(kiosk: Kiosk) -> None:
    kiosk.reconciler.step()
    kiosk.reconciler.step()
    assert kiosk.player.view.shown == Showing(BUNDLE, "shine")


def test_without_a_bundle_the_lamps_stay_off_and_the_log_says_why(kiosk: Kiosk) -> None:
    kiosk.bundles.installed = None
    kiosk.run(30)
    assert kiosk.state is State.OFF
    assert not kiosk.lit
    assert kiosk.codes.count("nothing-installed") == 1


def test_stops_on_request_and_cools_and_starts_again_only_when_asked(kiosk: Kiosk) -> None:
    kiosk.run_until(State.PLAYING)
    kiosk.reconciler.shut()
    kiosk.run_until(State.OFF)
    kiosk.run(60)
    assert kiosk.state is State.OFF
    assert kiosk.player.view.shown == BLACK
    kiosk.reconciler.open()
    kiosk.run_until(State.PLAYING)
    assert not kiosk.sins


@pytest.mark.parametrize("seed", range(4))
def test_whoever_opens_and_closes_at_any_moment_breaks_nothing_and_is_told_the_truth(kiosk: Kiosk, seed: int) -> None:
    random = Random(seed)
    dark_steps = 0
    for _ in range(200):
        if (press := random.random()) < 0.1:
            (kiosk.reconciler.open if press < 0.05 else kiosk.reconciler.shut)()
        for supervisor in kiosk.supervisors:
            if random.random() < 0.4:  # some projectors answer late
                supervisor.step()
        kiosk.reconciler.step()
        kiosk.world.time_s += STEP_S
        assert kiosk.state is not State.FAULT, kiosk.reconciler.machine.reason
        shows = kiosk.state in (State.READY, State.PLAYING, State.DEGRADED)
        dark_steps = dark_steps + 1 if shows and not kiosk.lit else 0
        assert dark_steps < 8, kiosk.told
    assert not kiosk.sins


def test_an_opening_right_after_a_closing_waits_for_the_lamps_and_says_so(kiosk: Kiosk) -> None:
    kiosk.run_until(State.PLAYING)
    kiosk.reconciler.shut()
    kiosk.run(1)
    kiosk.reconciler.open()
    kiosk.run(1)
    assert (kiosk.state, kiosk.reconciler.machine.reason) == (State.COOLING, "It opens when the lamps have cooled.")
    kiosk.run_until(State.PLAYING)
    assert "error" not in [row.level for row in kiosk.log.after(0)]


def test_a_stage_whose_lamps_somebody_switched_off_says_that_they_are_switched_on_again(kiosk: Kiosk) -> None:
    kiosk.run_until(State.PLAYING)
    for lamp in kiosk.lamps.values():
        lamp.go_dark()
    kiosk.run_until(State.POWERING, within_s=20)
    kiosk.run_until(State.PLAYING)


def test_a_request_that_is_refused_keeps_nothing_of_the_ones_before(kiosk: Kiosk) -> None:
    kiosk.reconciler.shut()
    frames = []
    for _ in range(3):
        with pytest.raises(WorkError, match="closed") as refused:
            kiosk.reconciler.next()
        frames.append(len(refused.traceback))
    assert frames == [frames[0]] * 3


def test_a_request_survives_a_restart_of_the_service(kiosk: Kiosk) -> None:
    kiosk.run_until(State.PLAYING)
    kiosk.reconciler.choose("marble")
    kiosk.reconciler.shut()
    kiosk.run_until(State.OFF)
    kiosk.log.close()
    kiosk.boot()
    kiosk.run(60)
    assert kiosk.state is State.OFF
    kiosk.reconciler.open()
    kiosk.run_until(State.PLAYING)
    assert kiosk.player.view.shown == Showing(BUNDLE, "marble")


def test_a_dead_lamp_degrades_and_the_others_take_over_with_their_own_frames(kiosk: Kiosk) -> None:
    beside = Path("bundles-without/left.vel")
    kiosk.run_until(State.PLAYING)
    kiosk.lamps["left"].burst()
    kiosk.run_until(State.DEGRADED)
    assert "left" in kiosk.reconciler.machine.reason
    kiosk.run(15)
    assert [kind for _, kind, _ in kiosk.jobs.done] == ["takeover"]
    kiosk.bundles.beside[frozenset({"left"})] = beside
    kiosk.run(2)
    assert kiosk.player.view.shown == Showing(beside, "shine")
    kiosk.lamps["left"].dud = False
    kiosk.run_until(State.PLAYING)
    assert kiosk.player.view.shown == Showing(BUNDLE, "shine")
    assert not kiosk.sins


def test_a_degraded_stage_says_what_is_wrong_now_not_what_was_wrong_first(kiosk: Kiosk) -> None:
    kiosk.run_until(State.PLAYING)
    kiosk.player.problem = Notice("player-not-started", "No X server answers.", "", Level.ERROR)
    kiosk.run_until(State.DEGRADED)
    kiosk.player.problem = Notice("bundle-damaged", "The bundle is damaged.", "", Level.ERROR)
    kiosk.run(2)
    assert kiosk.reconciler.machine.reason == "The bundle is damaged."
    kiosk.player.problem = None
    kiosk.run_until(State.PLAYING)


def test_a_remedy_that_several_have_is_said_once(kiosk: Kiosk) -> None:
    kiosk.run_until(State.PLAYING)
    for name in ("left", "right"):
        kiosk.lamps[name].trouble = "silent"
        kiosk.gone.add(name)
    kiosk.run_until(State.DEGRADED)
    kiosk.run(60)
    reason = kiosk.reconciler.machine.reason
    assert (reason.count("Plug it in."), "left" in reason, "right" in reason) == (1, True, True)


def test_a_lamp_that_never_lights_is_struck_three_times_and_left_alone_until_somebody_opens_again(kiosk: Kiosk) -> None:
    kiosk.lamps["left"].dud = True
    kiosk.run_until(State.DEGRADED, within_s=300)
    kiosk.run(1000)
    assert kiosk.lamps["left"].strikes == 3
    assert "lamp-given-up" in kiosk.codes
    assert not kiosk.sins


def test_a_silent_cable_degrades_but_takes_no_picture_away(kiosk: Kiosk) -> None:
    kiosk.run_until(State.PLAYING)
    kiosk.lamps["left"].trouble = "silent"
    kiosk.gone.add("left")
    kiosk.run_until(State.DEGRADED)
    assert kiosk.player.view.shown == Showing(BUNDLE, "shine")
    kiosk.gone.clear()
    kiosk.lamps["left"].trouble = ""
    kiosk.run_until(State.PLAYING)
    assert not kiosk.sins


def test_when_every_lamp_fails_it_is_a_fault_with_reason_and_it_comes_back_when_mended(kiosk: Kiosk) -> None:
    for lamp in kiosk.lamps.values():
        lamp.reports = ProjectorStatus(Power.FAULT, ("lamp-failed",))
    kiosk.run_until(State.FAULT)
    assert "lamp-failed" in kiosk.reconciler.machine.reason
    for lamp in kiosk.lamps.values():
        lamp.reports = None
    kiosk.run_until(State.PLAYING, within_s=1200)


@pytest.mark.parametrize("boots_s", [5, 12, 30, 60])
def test_projectors_that_boot_longer_than_the_computer_shine_soon_after_they_answer(kiosk: Kiosk, boots_s: int) -> None:
    kiosk.run_until(State.PLAYING)
    kiosk.gone.update(NAMES)
    kiosk.power_cut(1.0)
    kiosk.run(boots_s)
    assert kiosk.state is State.FAULT
    assert "left is away" in kiosk.reconciler.machine.reason
    assert kiosk.player.view.shown == Showing(BUNDLE, "shine"), "a lamp behind a dead control line may be lit"
    kiosk.gone.clear()
    rest_s = max(0.0, RULES.minimum_off_s - boots_s)
    longest_s = rest_s + max(2.0, boots_s / 3) + RULES.warm_up_s + RULES.stable_s + 5 * STEP_S
    assert kiosk.run_until(State.PLAYING) <= longest_s
    assert not kiosk.sins


def test_a_service_that_begins_while_all_control_lines_are_dead_leaves_the_picture_on_the_lit_lamps(
    kiosk: Kiosk,
) -> None:
    kiosk.run_until(State.PLAYING)
    kiosk.gone.update(NAMES)
    kiosk.log.close()
    kiosk.boot()
    kiosk.run(60)
    assert kiosk.lit == list(NAMES)
    assert kiosk.player.view.shown == Showing(BUNDLE, "shine")
    kiosk.gone.clear()
    kiosk.run_until(State.PLAYING, within_s=20)
    assert [lamp.strikes for lamp in kiosk.lamps.values()] == [1, 1, 1]
    kiosk.gone.update(NAMES)
    kiosk.reconciler.shut()
    kiosk.run(5)
    assert kiosk.player.view.shown == BLACK


def test_a_lamp_that_can_not_be_switched_off_is_a_fault(kiosk: Kiosk) -> None:
    kiosk.run_until(State.PLAYING)
    kiosk.lamps["right"].trouble = "refuse"
    kiosk.reconciler.shut()
    kiosk.run_until(State.FAULT)
    assert "right" in kiosk.reconciler.machine.reason
    assert kiosk.lit == ["right"]
    kiosk.lamps["right"].trouble = ""
    kiosk.run_until(State.OFF)


def test_a_job_that_needs_light_is_given_up_in_a_fault_and_does_not_wait_for_its_end(kiosk: Kiosk) -> None:
    for lamp in kiosk.lamps.values():
        lamp.reports = ProjectorStatus(Power.FAULT, ("lamp-failed",))
    kiosk.run_until(State.FAULT)
    kiosk.reconciler.submit(Request("quick", light=True))
    kiosk.run(5)
    assert "work-impossible" in kiosk.codes
    for lamp in kiosk.lamps.values():
        lamp.reports = None
    kiosk.run_until(State.PLAYING, within_s=1200)
    kiosk.run(60)
    assert kiosk.jobs.done == []


def test_without_a_camera_playback_goes_on_and_recalibration_says_why_it_cannot(kiosk: Kiosk) -> None:
    kiosk.jobs.camera = False
    kiosk.run_until(State.PLAYING)
    with pytest.raises(WorkError, match="no camera"):
        kiosk.reconciler.submit(Request("quick", light=True))
    kiosk.run(5)
    assert kiosk.state is State.PLAYING


def test_recalibrates_on_request_and_plays_again(kiosk: Kiosk) -> None:
    kiosk.run_until(State.PLAYING)
    kiosk.reconciler.submit(Request("quick", light=True))
    with pytest.raises(WorkError, match="Quick recalibration"):
        kiosk.reconciler.submit(Request("quick", light=True))
    kiosk.run_until(State.CALIBRATING)
    assert kiosk.player.want is None
    kiosk.run_until(State.PLAYING)
    assert [how for *_, how in kiosk.jobs.done] == ["done"]


def test_work_is_cancelled_and_playing_goes_on(kiosk: Kiosk) -> None:
    kiosk.run_until(State.PLAYING)
    kiosk.reconciler.submit(Request("quick", light=True))
    kiosk.run_until(State.CALIBRATING)
    kiosk.reconciler.cancel()
    kiosk.run_until(State.PLAYING, within_s=5)
    with pytest.raises(WorkError, match="No job is running"):
        kiosk.reconciler.cancel()


def test_a_camera_that_dies_in_a_calibration_ends_the_work_and_not_the_playing(kiosk: Kiosk) -> None:
    kiosk.run_until(State.PLAYING)
    kiosk.reconciler.submit(Request("quick", light=True))
    kiosk.run_until(State.CALIBRATING)
    kiosk.jobs.camera = False
    kiosk.run_until(State.PLAYING, within_s=5)


def test_a_hung_player_degrades_and_recovers(kiosk: Kiosk) -> None:
    kiosk.run_until(State.PLAYING)
    kiosk.player.hung_at_s = kiosk.world.time_s
    kiosk.run_until(State.DEGRADED, within_s=3)
    kiosk.run_until(State.PLAYING, within_s=10)


def test_lamps_that_burn_when_the_service_begins_are_not_struck_again(kiosk: Kiosk) -> None:
    kiosk.run_until(State.PLAYING)
    kiosk.log.close()
    kiosk.boot()
    assert kiosk.run_until(State.PLAYING) < 5
    assert [lamp.strikes for lamp in kiosk.lamps.values()] == [1, 1, 1]


def test_a_full_ledger_strikes_nothing_and_says_so(kiosk: Kiosk) -> None:
    kiosk.shelf.full = True
    kiosk.run_until(State.FAULT)
    assert not kiosk.lit
    kiosk.shelf.full = False
    kiosk.run_until(State.PLAYING, within_s=1200)
