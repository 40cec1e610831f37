from __future__ import annotations

from pathlib import Path

from controller.kiosk.api.kiosk import StageKiosk
from controller.kiosk.service import Service
from controller.kiosk.store.event_log import EventLog
from controller.stage.sessions.check import check_stage
from tests.controller.kiosk import contract
from tests.controller.kiosk.test_contract import install_two
from tests.controller.kiosk.vase import graded_run, vase


def test_the_grade_of_a_new_calibration_is_there_with_its_bundle(tmp_path: Path) -> None:
    stage = vase(tmp_path / "stage")
    (stage / "stage.toml").write_text(contract.TEXT)
    log = EventLog(stage / EventLog.FILE, durable=False)
    kiosk = StageKiosk(stage)
    kiosk.attach(Service(check_stage(stage), log))
    kiosk.service.changed()
    assert kiosk.snapshot().grades == ()
    run = graded_run(stage, "20260102-030405-calibrate", {"left": 0.012})
    install_two(stage)
    kiosk.service.changed()
    assert kiosk.snapshot().bundle is not None
    assert [grade.run for grade in kiosk.snapshot().grades] == [run.name]
    kiosk.service.jobs.close(60)
    log.close()
