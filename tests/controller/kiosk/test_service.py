"""How often a service decides."""

from __future__ import annotations

import threading
import time
from pathlib import Path

from controller.kiosk.service import STEP_S, Service
from controller.kiosk.store.event_log import EventLog
from controller.stage.sessions.check import check_stage
from tests.controller.kiosk.vase import vase


def test_a_service_to_which_nothing_happens_rests_between_two_decisions(tmp_path: Path) -> None:
    stage = vase(tmp_path)
    log = EventLog(stage / EventLog.FILE, durable=False)
    service, cancel, times = Service(check_stage(stage), log), threading.Event(), list[float]()

    def alive() -> None:
        times.append(time.monotonic())
        if len(times) == 5:
            cancel.set()

    service.alive = alive
    service.run(cancel)
    log.close()
    assert times[4] - times[0] > 2 * STEP_S
