"""Jobs of a kiosk: numbered, followed over its API, and kept apart from what else is asked of it meanwhile."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from controller.cli import kiosk_process as program
from controller.core.errors import VelaturaError, WorkError
from controller.core.storage import runtime_folder, write_atomically
from controller.kiosk.api import kiosk as kiosk_module
from controller.kiosk.api.control import NAME, ControlServer
from controller.kiosk.api.kiosk import StageKiosk
from controller.kiosk.api.offline_dispatch import ask_and_follow
from controller.kiosk.decide.interfaces import Request
from controller.kiosk.operations.dispatch import socket_table
from controller.kiosk.service import Service
from controller.kiosk.state import Job
from controller.kiosk.store import archive
from controller.kiosk.store.accounts import Accounts, Role
from controller.kiosk.store.event_log import EventLog
from controller.kiosk.values import Schedule
from controller.run.progress import Silent
from controller.stage.sessions.check import check_stage
from hal.deadline import Cancelled
from hal.notices import Notice
from tests.controller.kiosk.vase import graded_run, vase

PNG = b"\x89PNG, as far as anybody looks"


@pytest.fixture
def kiosk(tmp_path: Path) -> Iterator[StageKiosk]:
    """A calibrated stage whose service has done seven jobs before it started again; it is moved by hand."""
    stage = vase(tmp_path)
    graded_run(stage, "20260101-100000-calibrate", {"left": 0.01})
    (stage / "target.png").write_bytes(PNG)
    log = EventLog(stage / EventLog.FILE, durable=False)
    log.keep("job", "7")
    found = StageKiosk(stage)
    found.attach(Service(check_stage(stage), log))
    yield found
    found.service.jobs.close(20)
    log.close()


def asked(kiosk: StageKiosk) -> Job:
    return kiosk.compute("wood", kiosk.stage / "target.png")


def test_jobs_are_numbered_on_over_restarts_of_the_service(kiosk: StageKiosk) -> None:
    job = asked(kiosk)
    assert job.number == 8
    assert kiosk.job(8) is None, "it waits"
    kiosk.service.reconciler.step()
    kiosk.service.jobs.close(20)
    ended = kiosk.job(8)
    assert ended is not None
    assert (ended.number, ended.ended, ended.failed) == (8, True, True)


def test_work_that_is_given_up_before_it_begins_is_told_to_whoever_follows_it(kiosk: StageKiosk) -> None:
    number = asked(kiosk).number
    kiosk.cancel()
    with pytest.raises(WorkError) as caught:
        kiosk.job(number)
    assert caught.value.code == "job-given-up"
    assert "work-cancelled" in [row.code for row in kiosk.events()]


def followed(kiosk: StageKiosk, cancel: threading.Event | None = None, **instead: Any) -> Mapping[str, Any]:
    served = socket_table(kiosk.holders()) | instead
    with ControlServer(runtime_folder(kiosk.stage.resolve()) / NAME, served):
        arguments = {"name": "wood", "target": str(kiosk.stage / "target.png")}
        return ask_and_follow(stage=kiosk.stage, op="compute", arguments=arguments, reporter=Silent(),
                              cancel=cancel or threading.Event(), every_s=0.01)  # fmt: skip


def test_who_stops_following_a_job_that_ends_at_that_moment_has_stopped(kiosk: StageKiosk) -> None:
    cancel = threading.Event()

    def job(number: int) -> Job:
        kiosk.cancel()
        cancel.set()
        return Job(number, "New appearance")

    with pytest.raises(Cancelled):
        followed(kiosk, cancel, job=job)
    assert not kiosk.service.reconciler.working


def test_who_stops_following_cancels_the_job(kiosk: StageKiosk) -> None:
    cancel = threading.Event()
    cancel.set()
    with pytest.raises(Cancelled):
        followed(kiosk, cancel)
    assert not kiosk.service.reconciler.working


def test_who_follows_work_that_never_begins_does_not_wait_for_ever(kiosk: StageKiosk) -> None:
    def compute(name: str, target: str) -> Job:
        job = asked(kiosk)
        kiosk.stop()
        return job

    with pytest.raises(VelaturaError) as caught:
        followed(kiosk, compute=compute)
    assert caught.value.code == "job-given-up"


def test_who_follows_hears_of_his_own_job_though_another_one_has_begun_since(kiosk: StageKiosk) -> None:
    def compute(name: str, target: str) -> Job:
        first = asked(kiosk)
        kiosk.service.reconciler.step()
        kiosk.service.jobs.close(20)
        kiosk.service.reconciler.step()
        asked(kiosk)
        kiosk.service.reconciler.step()
        return first

    with pytest.raises(WorkError) as caught:
        followed(kiosk, compute=compute)
    assert caught.value.code == "job-failed"
    assert caught.value.what.startswith("New appearance wood: ")


class ToldMeanwhile(EventLog):
    """Another thread tells something as soon as somebody has looked at its number."""

    meanwhile: Callable[[], object] | None = None

    @property
    def number(self) -> int:
        found, meanwhile = super().number, self.meanwhile
        self.meanwhile = None
        if meanwhile is not None:
            meanwhile()
        return found


def test_an_event_that_is_told_while_the_panel_is_brought_up_to_date_reaches_it(tmp_path: Path) -> None:
    stage, heard = vase(tmp_path), list[int]()
    log = ToldMeanwhile(stage / EventLog.FILE, durable=False)
    found = StageKiosk(stage)
    found.attach(service := Service(check_stage(stage), log))
    for _ in range(2):
        service.changed()
    found.subscribe(lambda: heard.append(found.events()[-1].number))
    log.meanwhile = lambda: log.add(Notice("lamp-went-off", "The lamp went off."))
    for _ in range(2):
        service.changed()
    assert heard[-1:] == [log.number]
    log.close()


def elsewhere(do: Callable[[], object]) -> str:
    """The code with which another technician is refused; empty where they are not."""
    with ThreadPoolExecutor(1) as other:
        error = other.submit(do).exception(20)
    return error.code if isinstance(error, VelaturaError) else ""


def test_of_two_technicians_with_a_new_appearance_at_once_one_is_refused_and_changes_nothing(
    kiosk: StageKiosk, monkeypatch: pytest.MonkeyPatch
) -> None:
    refused: list[str] = []

    def other() -> Job:
        return kiosk.compute("stone", kiosk.stage / "target.png")

    def write(path: Path, data: bytes) -> None:
        if not refused:
            refused.append("asked")
            refused.append(elsewhere(other))
        write_atomically(path, data)

    monkeypatch.setattr(kiosk_module, "write_atomically", write)
    assert asked(kiosk).name == "New appearance"
    assert refused == ["asked", "busy"]
    assert '"wood"' in kiosk.settings()
    assert '"stone"' not in kiosk.settings()


def test_no_work_begins_while_a_backup_takes_the_place_of_what_it_reads(
    kiosk: StageKiosk, monkeypatch: pytest.MonkeyPatch
) -> None:
    refused: list[str] = []

    def restore(stage: Path, backup: Path) -> None:
        refused.append(elsewhere(lambda: kiosk.service.submit(Request("publish"))))
        kiosk.service.reconciler.step()

    monkeypatch.setattr(archive, "restore", restore)
    kiosk.restore(kiosk.stage / "backup.tar.gz")
    assert refused == ["busy"]
    assert kiosk.service.jobs.job is None
    assert asked(kiosk).name == "New appearance", "and then it may"


def test_who_follows_work_that_was_given_up_is_not_told_of_the_next_ones_outcome(kiosk: StageKiosk) -> None:
    given_up = asked(kiosk)
    kiosk.cancel()
    following = asked(kiosk)
    assert following.number != given_up.number
    assert kiosk.job(following.number) is None, "it waits"
    with pytest.raises(WorkError) as caught:
        kiosk.job(given_up.number)
    assert caught.value.code == "job-given-up"


def test_hours_that_are_sent_while_the_service_is_made_anew_are_refused_and_not_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kiosk, cancel, refused = StageKiosk(vase(tmp_path)), threading.Event(), list[str]()

    @contextlib.contextmanager
    def serving(
        stage: Path, cancel: threading.Event, *, leave_lit: bool, alive: Callable[[], None]
    ) -> Iterator[Service]:
        log = EventLog(stage / EventLog.FILE, durable=False)
        service = Service(check_stage(stage), log)  # it has read the hours
        if refused:
            cancel.set()
        refused.append(elsewhere(lambda: kiosk.set_schedule(Schedule("UTC"))))
        kiosk.reload.set()  # somebody has saved settings
        yield service
        service.changed()
        log.close()

    monkeypatch.setattr(program, "serving", serving)
    monkeypatch.setattr(program, "StageKiosk", lambda stage: kiosk)
    program.serve(stage=tmp_path, panel=None, leave_lit=False, setup=False, reporter=Silent(), cancel=cancel)
    assert refused == ["not-set-up", "kiosk-restarting"]
    assert not (tmp_path / "schedule.toml").exists()


def test_of_two_at_the_socket_of_a_kiosk_without_panel_neither_loses_an_account(
    kiosk: StageKiosk, monkeypatch: pytest.MonkeyPatch
) -> None:
    (kiosk.stage / "kiosk/panel/accounts.json").unlink()
    asked_for, add, other = socket_table(kiosk.holders()), Accounts.add, ["otto"]

    def slowly(accounts: Accounts, name: str, role: Role, password: str) -> None:
        if other:
            asked_for["add-account"](other.pop(), "viewer", "a good long one")
        add(accounts, name, role, password)

    monkeypatch.setattr(Accounts, "add", slowly)
    asked_for["add-account"]("vera", "viewer", "a good long one")
    assert [one.name for one in asked_for["accounts"]()] == ["otto", "vera"]


def test_a_bundle_of_a_newer_format_is_made_again_at_the_start(
    kiosk: StageKiosk, monkeypatch: pytest.MonkeyPatch
) -> None:
    (kiosk.stage / "bundles").mkdir()
    newer = b"VELBUNDL" + (99).to_bytes(4, "little") + bytes(200)
    (kiosk.stage / "bundles" / f"{'0' * 64}.vel").write_bytes(newer)
    asked: list[Request] = []
    monkeypatch.setattr(Service, "_thread", lambda *_, **__: None)
    monkeypatch.setattr(Service, "submit", lambda self, *requests: asked.extend(requests))
    kiosk.service.start()
    assert [request.kind for request in asked] == ["publish"]
    assert "bundle-other-format" in [row.code for row in kiosk.events()]
