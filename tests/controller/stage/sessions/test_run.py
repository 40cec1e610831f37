"""The composition root with drivers of models: what is opened when, and how everything is left."""

from __future__ import annotations

import errno
import socket
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import pytest

from controller.core.errors import UsageError, WorkError
from controller.core.storage import exclusive, runtime_folder, runtime_path
from controller.run.journal import Journal
from controller.run.runner import Context, Step
from controller.run.state_machine import Event
from controller.run.step_id import StepId
from controller.stage.rig.rig import Rig
from controller.stage.sessions.check import check_stage
from controller.stage.sessions.run import LOCK, unfinished_run
from controller.stage.sessions.session import OwnSession, StageWork
from hal.deadline import Cancelled
from hal.errors import DeviceError, DeviceGone, DriverFault
from hal.notices import Level
from tests.controller.stage.sessions.run_models import STAGE, Models


@pytest.fixture
def models(tmp_path: Path) -> Models:
    return Models(tmp_path)


def test_lamps_are_lit_while_the_work_goes_on_and_off_afterwards(models: Models) -> None:
    seen: list[bool] = []

    def work(context: Context) -> Sequence[Path]:
        seen.extend(lamp.lit for lamp in models.lamps.values())
        return ()

    run = models.run(work)
    assert seen == [True, True]
    assert [(lamp.lit, lamp.open) for lamp in models.lamps.values()] == [(False, False)] * 2
    assert models.states() == [
        "off -> powering", "powering -> warming", "warming -> ready", "ready -> cooling", "cooling -> off",
    ]  # fmt: skip
    with Journal(run) as journal:
        assert journal.outcomes() == [("trial", "done")]


def test_what_needs_no_stable_light_is_done_while_lamps_become_stable(models: Models) -> None:
    """In the order of the list otherwise; the state says whether the lamps are stable."""
    (models.folder / "stage.toml").write_text(STAGE + "stable_s = 0.5\n")
    done: list[tuple[str, str]] = []

    def steps(rig: Rig, run: Path) -> Sequence[Step]:
        def noting(name: str, context: Context) -> Sequence[Path]:
            stable = max(guard.stable_left_s() for guard in rig.guards) <= 0
            done.append((name, "stable" if stable else "not yet"))
            assert all(lamp.lit for lamp in models.lamps.values())
            return ()

        names = {"first": False, "delay": True, "last": False}
        return [Step(StepId(name), partial(noting, name), unsteady=early) for name, early in names.items()]

    checked = check_stage(models.folder, drivers=models.drivers)
    OwnSession(models.folder).run(checked, StageWork("trial", steps), reporter=models.told, cancel=models.cancel)
    assert done == [("delay", "not yet"), ("first", "stable"), ("last", "stable")]


def test_the_folder_of_sockets_goes_with_the_run_unless_a_player_has_said_something(models: Models) -> None:
    folder = runtime_path(models.folder)

    def work(context: Context) -> Sequence[Path]:
        assert folder.is_dir()
        return ()

    models.run(work)
    assert not folder.exists()
    (runtime_folder(models.folder) / "player.log").write_text("no display")
    models.run(work)
    assert [path.name for path in folder.iterdir()] == ["player.log"]


def test_the_folder_of_sockets_stays_while_a_program_serves_in_it(models: Models) -> None:
    folder = runtime_folder(models.folder)
    with socket.socket(socket.AF_UNIX) as served:
        served.bind(str(folder / "player.sock"))
        served.listen()
        models.run()
        assert folder.is_dir()
    models.run()
    assert not folder.exists()


@pytest.mark.parametrize("error", [ZeroDivisionError(), Cancelled(), WorkError("bad", what="Bad.", remedy="Mend.")])
def test_whatever_the_work_raises_the_lamps_go_off_and_the_error_comes_through(
    models: Models, error: BaseException
) -> None:
    def work(context: Context) -> Sequence[Path]:
        raise error

    with pytest.raises(type(error)) as raised:
        models.run(work)
    assert raised.value is error
    assert not any(lamp.lit for lamp in models.lamps.values())
    assert models.states()[-1] == "cooling -> off"


def test_what_a_projector_is_odd_in_is_told_once_and_stops_nothing(models: Models) -> None:
    models.odd_in = "The lamp hours of projector left stay unknown."
    run = models.run()
    assert [text for level, text in models.told.said if level is Level.WARNING] == [models.odd_in]
    with Journal(run) as journal:
        assert [event.text for event in journal.events() if event.code == "projector-answer-odd"] == [models.odd_in]


def test_a_lamp_that_stays_lit_is_a_failure_though_the_work_is_done(models: Models) -> None:
    models.stuck = {"A"}
    with pytest.raises(DeviceError) as failed:
        models.run()
    assert failed.value.code == "lamp-still-lit"
    assert "left" in failed.value.what
    assert "right" not in failed.value.what
    assert not models.lamps["B"].lit
    assert any(level is Level.ERROR and "left could not" in text for level, text in models.told.said)
    assert models.states()[-1] == "ready -> cooling"


def test_a_lamp_that_stays_lit_does_not_hide_why_the_work_failed(models: Models) -> None:
    models.stuck = {"A"}

    def work(context: Context) -> Sequence[Path]:
        raise WorkError("bad", what="Bad.", remedy="Mend.")

    with pytest.raises(WorkError) as failed:
        models.run(work)
    assert failed.value.code == "bad"
    assert any("left could not" in text for _, text in models.told.said)


def test_a_driver_that_fails_to_close_is_told_and_keeps_nothing_else_open(models: Models) -> None:
    models.unclosable = {"B"}
    with pytest.raises(DriverFault, match="'model' of projector right raised OSError"):
        models.run()
    assert [lamp.open for lamp in models.lamps.values()] == [False, True]
    assert models.states()[-1] == "cooling -> off"


def test_a_driver_that_fails_to_close_does_not_hide_why_the_work_failed(models: Models) -> None:
    models.unclosable = {"B"}

    def work(context: Context) -> Sequence[Path]:
        raise WorkError("bad", what="Bad.", remedy="Mend.")

    with pytest.raises(WorkError) as failed:
        models.run(work)
    assert "projector right" in failed.value.__notes__[0]
    assert not models.lamps["A"].open


def test_a_terminal_that_went_away_keeps_no_lamp_lit(models: Models) -> None:
    models.stuck = {"A"}

    def work(context: Context) -> Sequence[Path]:
        models.told.closed = True
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")

    with pytest.raises(BrokenPipeError):
        models.run(work)
    assert not models.lamps["B"].lit
    assert models.states()[-1] == "ready -> cooling"


def test_a_stage_at_work_is_refused_before_any_device_is_opened(models: Models) -> None:
    with exclusive(models.folder / LOCK, what_is_running="Another"), pytest.raises(UsageError) as refused:
        models.run()
    assert refused.value.code == "already-running"
    assert models.lamps == {}
    assert not (models.folder / "runs").exists()


def test_a_device_that_can_not_be_opened_begins_no_run_and_leaves_the_others_closed(models: Models) -> None:
    models.camera_error = DeviceGone("camera-off", what="Off.", remedy="Switch it on.")
    with pytest.raises(DeviceGone):
        models.run()
    assert [lamp.open for lamp in models.lamps.values()] == [False, False]
    assert not any(lamp.lit for lamp in models.lamps.values())
    assert not (models.folder / "runs").exists()


def test_what_a_driver_finds_wrong_in_its_settings_is_told_with_the_line(models: Models) -> None:
    (models.folder / "stage.toml").write_text(STAGE.replace('port = "B"', 'port = "nowhere"'))
    with pytest.raises(UsageError) as wrong:
        models.run()
    assert wrong.value.code == "setting-wrong"
    assert wrong.value.what == "stage.toml, line 12: The setting 'port' is 'nowhere'."


def test_an_output_that_the_display_does_not_have_is_told_with_those_it_has(models: Models) -> None:
    (models.folder / "stage.toml").write_text(STAGE.replace('"P2"', '"P3"'))
    with pytest.raises(UsageError, match="one of P1, P2") as wrong:
        models.run()
    assert wrong.value.code == "stage-key-value"


def test_an_unknown_driver_is_told_with_those_there_are(models: Models) -> None:
    (models.folder / "stage.toml").write_text(
        STAGE.replace('[camera]\ndriver = "model"', '[camera]\ndriver = "modell"')
    )
    with pytest.raises(UsageError) as wrong:
        check_stage(models.folder, drivers=models.drivers)
    assert wrong.value.what == "stage.toml, line 14: in [camera] 'driver' = 'modell' is not a camera driver."
    assert wrong.value.remedy == "'driver' is one of model."


def test_a_run_that_failed_goes_on_in_its_folder_and_one_that_is_done_does_not(models: Models) -> None:
    def fails(context: Context) -> Sequence[Path]:
        (context.folder / ".half.npz.x1.part").write_bytes(b"half")
        raise WorkError("bad", what="Bad.", remedy="Mend.")

    with pytest.raises(WorkError):
        models.run(fails)
    (failed,) = (models.folder / "runs").iterdir()
    assert unfinished_run(models.folder, "trial") == failed
    assert models.run() == failed
    assert not list(failed.glob(".*.part"))  # as a killed process leaves them
    following = unfinished_run(models.folder, "trial")
    assert following.name.endswith("-trial")
    assert not following.exists() or following == failed  # the same second names the same folder
    assert unfinished_run(models.folder, "other").name.endswith("-other")


def test_a_new_run_is_newer_than_one_of_a_clock_that_was_years_ahead(models: Models) -> None:
    (models.folder / "runs" / "20990504-120000-calibrate").mkdir(parents=True)
    assert unfinished_run(models.folder, "trial").name == "20990504-120001-trial"


def test_the_same_step_is_not_done_twice_when_a_run_goes_on(models: Models) -> None:
    done: list[str] = []

    def steps(rig: Rig, run: Path) -> Sequence[Step]:
        def first(context: Context) -> Sequence[Path]:
            done.append("first")
            return ()

        def second(context: Context) -> Sequence[Path]:
            done.append("second")
            if done.count("second") == 1:
                raise Cancelled
            return ()

        return [
            Step(StepId("first"), first, enter=Event.RECALIBRATE, leave=Event.CALIBRATED),
            Step(StepId("second"), second),
        ]

    checked = check_stage(models.folder, drivers=models.drivers)
    with pytest.raises(Cancelled):
        OwnSession(checked.stage.folder).run(
            checked, StageWork("trial", steps), reporter=models.told, cancel=models.cancel
        )
    OwnSession(checked.stage.folder).run(checked, StageWork("trial", steps), reporter=models.told, cancel=models.cancel)
    assert done == ["first", "second", "second"]


def test_a_finished_run_stays_finished_when_other_work_in_its_folder_fails(models: Models) -> None:
    folder = models.folder / "runs" / "20260101-020000-calibrate"
    with Journal(folder) as journal:
        with journal.run("calibrate"):
            pass
        with pytest.raises(RuntimeError), journal.run("appearance"):
            raise RuntimeError
    assert unfinished_run(models.folder, "calibrate") != folder
