"""The real kiosk and the panel's double keep the same contract."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import trimesh

from controller.bundle.describe import png
from controller.bundle.install import current, install
from controller.bundle.writer import NewAppearance, NewBundle, write_bundle
from controller.core.errors import UsageError
from controller.kiosk import service as service_module
from controller.kiosk.api import finding
from controller.kiosk.api.kiosk import StageKiosk
from controller.kiosk.decide.interfaces import Finished, PlayerView, Request, Showing
from controller.kiosk.jobs.job_runner import JobHandler, JobReporter
from controller.kiosk.operations.dispatch import socket_table
from controller.kiosk.schedule import WEEKDAYS
from controller.kiosk.service import Service
from controller.kiosk.store.event_log import EventLog
from controller.kiosk.values import Schedule, ScheduleRow
from controller.stage.doctor.values import Examination
from controller.stage.sessions.check import check_stage
from hal.notices import Notice
from tests.controller.kiosk import contract
from tests.controller.kiosk.contract import OTHER, PLAYING, RUN, Contract
from tests.controller.kiosk.vase import graded_run, vase
from tests.controller.panel.memory_kiosk import MemoryKiosk
from tests.waiting import wait_for

test_every_operation_of_a_kiosk_is_in_the_contract = contract.test_every_operation_of_a_kiosk_is_in_the_contract


@dataclass
class Real:
    """A kiosk over its service, whose devices no one opens and whose work waits: no thread moves it."""

    kiosk: StageKiosk
    folder: Path

    def settle(self) -> None:
        service = self.kiosk.service
        service.reconciler.step()
        # The player shows what is wanted.
        vars(service.player)["_view"] = PlayerView(service.player.want)
        service.changed()


@dataclass
class Double:
    kiosk: MemoryKiosk
    folder: Path

    def settle(self) -> None:
        """It shows everything at once."""


def install_two(stage: Path) -> None:
    frames = {"P1": np.zeros((1050, 1400, 3), np.uint8)}
    preview = png(np.full((4, 6, 3), 90, np.uint8))
    made = [NewAppearance(PLAYING, frames, thumbnail=preview), NewAppearance(OTHER, frames)]
    write_bundle(
        stage / "made.vel",
        NewBundle(stage="The vase", calibration=RUN, created_unix_s=1_767_600_000, outputs=[("P1", 1400, 1050)]),
        appearances=made,
        key=None,
    )
    install(stage / "made.vel", stage / "bundles", trusted=(), allow_unsigned=True)


def is_wanted(service: Service, name: str) -> bool:
    return service.player.want is not None and service.player.want.appearance == name


def endless(request: Request, reporter: JobReporter, cancel: threading.Event) -> Finished:
    cancel.wait(60)
    return Finished(request, Notice("cancelled", "It was cancelled."), failed=True)


class TestStageKiosk(Contract):
    @pytest.fixture
    def stage(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Real]:
        monkeypatch.setattr(finding, "examine", lambda **_: Examination((), (), (), ()))
        stage = vase(tmp_path / "stage")
        (stage / "stage.toml").write_text(contract.TEXT)
        graded_run(stage, RUN, {"left": 0.01})
        (stage / "runs" / RUN / "geometry.json").write_text('{"camera": {"size_px": [240, 160]}}')
        (stage / "meshes").mkdir()
        trimesh.creation.box().export(stage / "meshes" / "bust.glb")
        install_two(stage)
        log = EventLog(stage / EventLog.FILE, durable=False)
        log.add(Notice("first", "It begins."))
        service = Service(check_stage(stage), log)
        # Work that only devices can do waits for its end instead; whether it may begin is the kiosk's own to say.
        runner = vars(service.jobs)
        runner["_handlers"] = {name: JobHandler(endless) for name in runner["_handlers"]}
        vars(service.player)["_view"] = PlayerView(Showing(current(stage / "bundles"), PLAYING))
        kiosk = StageKiosk(stage)
        kiosk.attach(service)
        service.changed()
        yield Real(kiosk, stage)
        service.jobs.close(20)
        log.close()

    def test_each_projector_names_the_output_that_feeds_it(self, stage: Real) -> None:
        (projector,) = (row for row in stage.kiosk.snapshot().devices if row.kind == "projector")
        assert (projector.name, projector.output) == ("left", "P1")

    def test_hours_that_close_the_show_say_so_before_they_are_saved(self, stage: Real) -> None:
        stage.kiosk.service.reconciler.step()
        hour = datetime.now(UTC) + timedelta(hours=3)
        later = [f"{(hour + timedelta(minutes=n)):%H:%M}" for n in (0, 10)]
        rows = tuple(ScheduleRow(day, *later) for day in WEEKDAYS)
        told = stage.kiosk.effect_of_schedule(Schedule("UTC", rows))
        assert told.startswith("The stage closes at once")
        assert stage.kiosk.schedule().rows == ()

    def test_what_a_person_asks_for_waits_for_no_step(self, stage: Real, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(service_module, "STEP_S", 60.0)
        service, cancel = stage.kiosk.service, threading.Event()
        thread = threading.Thread(target=service.run, args=(cancel,))
        thread.start()
        try:
            for name in (OTHER, PLAYING, OTHER):
                stage.kiosk.play(name)
                wait_for(partial(is_wanted, service, name))
        finally:
            cancel.set()
            service.hurry()
            thread.join()

    def test_the_socket_logs_what_was_done_and_what_was_refused(self, stage: Real) -> None:
        ask = socket_table(stage.kiosk.holders())
        ask["play"](OTHER)
        with pytest.raises(UsageError):
            ask["play"]("no such")
        told = {row.code: row.text.partition(": ")[2] for row in stage.kiosk.events()}
        assert told["done-by"] == f"Show this appearance now ({OTHER})."
        assert told["refused"].startswith("Show this appearance now (no such). Refused: The installed bundle")

    def test_settings_wait_for_no_job_in_the_background(self, stage: Real) -> None:
        service = stage.kiosk.service
        with service.reconciler.idle():
            service.submit(Request("variants"))
        service.reconciler.step()
        assert service.jobs.running == Request("variants")
        stage.kiosk.save_settings(contract.TOML)
        service.reconciler.step()
        assert service.jobs.running == Request("variants"), "it is done afterwards"

    def test_a_new_appearance_is_announced_until_it_is_shown(self, stage: Real) -> None:
        kiosk, service = stage.kiosk, stage.kiosk.service
        kiosk.stop()
        vars(service.jobs)["_handlers"]["compute"] = JobHandler(
            lambda request, *_: Finished(request, Notice("", "Done."))
        )
        service.submit(Request("compute", arguments=(OTHER,)))
        service.reconciler.step()
        wait_for(lambda: service.jobs.job is not None and service.jobs.job.ended)
        service.reconciler.step()
        service.submit(Request("variants"))
        service.reconciler.step()
        service.changed()
        assert kiosk.snapshot().made == OTHER
        vars(service.player)["_view"] = PlayerView(Showing(current(stage.folder / "bundles"), OTHER))
        service.changed()
        assert kiosk.snapshot().made == ""

    def test_a_closed_stage_that_computes_says_so(self, stage: Real) -> None:
        kiosk, service = stage.kiosk, stage.kiosk.service
        hour = datetime.now(UTC) + timedelta(hours=3)
        later = [f"{(hour + timedelta(minutes=n)):%H:%M}" for n in (0, 10)]
        kiosk.set_schedule(Schedule("UTC", tuple(ScheduleRow(day, *later) for day in WEEKDAYS)))
        service.reconciler.step()
        stage.settle()
        assert (kiosk.snapshot().state, kiosk.snapshot().job) == ("off", None)
        target = stage.folder / "target.png"
        target.write_bytes(png(np.full((160, 240, 3), 90, np.uint8)))
        kiosk.compute("grey", target)
        service.reconciler.step()
        stage.settle()
        shown = kiosk.snapshot()
        assert shown.job is not None
        assert (shown.state, shown.reason) == (
            "solving", f"{shown.job.name}. The stage is closed, and the lamps are off.",
        )  # fmt: skip


class TestMemoryKiosk(Contract):
    @pytest.fixture
    def stage(self, tmp_path: Path) -> Iterator[Double]:
        kiosk = MemoryKiosk(tmp_path / "pictures", step_s=0.5, names=(PLAYING, OTHER), run=RUN, toml=contract.TEXT)
        yield Double(kiosk, tmp_path)
        kiosk.close()
