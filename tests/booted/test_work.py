"""What a booted kiosk calibrates and computes, also where it is closed or the power fails meanwhile."""

from __future__ import annotations

from typing import Any

from controller.run.progress import RISE, SLACK_S
from tests.booted.kiosk import PICTURE_S, Kiosk
from tests.booted.machine import STAGE
from tests.campaigns.power_cuts import cut_now, kept, lost


def test_a_calibration_uses_the_same_player_and_what_it_made_plays(playing: Kiosk) -> None:
    machine = playing.machine
    playing.let_the_camera_see()
    player = machine.call("systemctl", "show", "--property=MainPID", "velatura-player")
    shown: list[tuple[float, str]] = []

    def note(job: dict[str, Any]) -> None:
        if not job.get("ended", True) and job["left_s"] is not None and job["name"] == "Full recalibration":
            shown.append((job["left_s"], job["why"]))

    playing.calibrate(note)
    assert len(shown) > 10
    least_s = float("inf")
    for left_s, why in shown:
        assert left_s <= RISE * least_s + SLACK_S or why, "the time left rose, and nobody said why"
        least_s = min(least_s, left_s)
    assert playing.shows_installed()
    assert machine.call("systemctl", "show", "--property=MainPID", "velatura-player") == player
    assert machine.restarts("velatura-controller") == 0


def works(status: dict[str, Any], name: str) -> bool:
    job = status["job"] or {}
    return str(job.get("name", "")).startswith(name) and bool(job["steps"]) and not job["ended"]


def test_a_closed_stage_that_computes_says_so_and_not_only_that_it_is_closed(playing: Kiosk) -> None:
    machine, number = playing.machine, playing.events()[-1]["number"]
    machine.call("velatura", "kiosk", "stop", STAGE, user="velatura")
    machine.wait_for(lambda: playing.state == "off")
    playing.begin_appearance("dark", 5)
    seen: list[tuple[str, str]] = []

    def published() -> bool:
        status = playing.status()
        job = status["job"] or {}
        if job.get("name") == "New appearance dark" and not job["ended"]:
            seen.append((status["state"], status["reason"]))
        return "published" in playing.codes(number)

    machine.wait_for(published)
    assert len(seen) > 3
    assert set(seen) == {("solving", "New appearance dark. The stage is closed, and the lamps are off.")}
    machine.wait_for(lambda: playing.state == "off")
    machine.call("velatura", "kiosk", "start", STAGE, user="velatura")
    machine.wait_for(lambda: playing.state == "playing")
    machine.wait_for(playing.shows_installed)


def test_power_cuts_while_it_calibrates_and_publishes_leave_the_picture_and_are_told(playing: Kiosk) -> None:
    machine = playing.machine
    calibrated = len(list(machine.at(STAGE / "runs").iterdir()))
    machine.wait_for(lambda: playing.state == "playing" and not playing.problems())
    playing.begin("calibrate")
    machine.wait_for(lambda: works(playing.status(), "Full recalibration"))
    before, number = kept(playing), playing.events()[-1]["number"]
    assert cut_now(playing, playing.shows_installed) < PICTURE_S
    assert lost(playing, before) == []
    machine.wait_for(lambda: "work-cut-off" in playing.codes(number))
    assert len(list(machine.at(STAGE / "runs").iterdir())) == calibrated + 1, "the calibration can continue"
    machine.wait_for(playing.answers)
    playing.begin_appearance("random", 1)
    machine.wait_for(lambda: works(playing.status(), "New appearance random"))
    before, number = kept(playing), playing.events()[-1]["number"]
    assert cut_now(playing, playing.shows_installed) < PICTURE_S
    assert lost(playing, before) == []
    machine.wait_for(lambda: {"work-cut-off", "published"} <= set(playing.codes(number)))
    shown = machine.call("velatura", "kiosk", "appearances", STAGE, user="velatura")
    assert "random" in shown, "what needs no lamps is done again by itself"
