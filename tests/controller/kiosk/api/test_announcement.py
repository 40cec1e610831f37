"""The text on the projectors of a stage that somebody sets up: how long it stays, and when it does not come."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from controller.kiosk.api.attached import LIT_FOR_NOTICE_S
from controller.kiosk.api.kiosk import StageKiosk
from controller.kiosk.service import Service
from controller.kiosk.store.event_log import EventLog
from controller.stage.sessions.check import check_stage
from tests.controller.kiosk.supervisors.test_mains_supervisor import KioskWorld
from tests.controller.kiosk.vase import vase
from tests.controller.stage.rig.lamp_model import World

TEXT = ("velatura.local", "code 1234")


@pytest.fixture
def hands() -> World:
    """Time that is moved by hand."""
    return World()


@pytest.fixture
def kiosk(tmp_path: Path, hands: World) -> Iterator[StageKiosk]:
    stage = vase(tmp_path)
    log = EventLog(stage / EventLog.FILE, durable=False)
    world = KioskWorld(hands)
    found = StageKiosk(stage, world)
    found.attach(Service(check_stage(stage), log, world=world))
    yield found
    log.close()


def test_it_stays_for_its_time(kiosk: StageKiosk, hands: World) -> None:
    kiosk.announce(TEXT, lambda: False)
    service = kiosk.service
    for passed_s in (0.0, 1.0, LIT_FOR_NOTICE_S - 1):
        hands.time_s = 1000.0 + passed_s
        service.changed()
        assert service.player.notice == TEXT
    hands.time_s += 2.0
    service.changed()
    assert service.player.notice == ()


def test_it_ends_once_somebody_has_entered(kiosk: StageKiosk) -> None:
    entered, shown = threading.Event(), list[tuple[str, ...]]()
    kiosk.announce(TEXT, entered.is_set)
    for _ in range(2):
        kiosk.service.changed()
        shown.append(tuple(kiosk.service.player.notice))
        entered.set()
    assert shown == [TEXT, ()]
