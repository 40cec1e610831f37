"""Every projector driver against the shared conformance suite, over real bytes."""

from __future__ import annotations

from functools import partial
from typing import Any

import pytest

from hal.conformance import ProjectorConformance
from hal.interfaces import Projector
from lab.emulated.projectors.boards import BOARDS, baud_of, login_of
from plugins.emulated.projectors.board import OptomaBoard, OptomaQuirks


class TestSerialProjector(ProjectorConformance):
    poll_s = 0.05

    @pytest.fixture
    def projector(self, open_serial: Any) -> Projector:
        driver: Projector = open_serial().driver
        return driver


class TestSerialProjectorThatAcknowledgesQuestionsFirst(ProjectorConformance):
    poll_s = 0.05

    @pytest.fixture
    def projector(self, open_serial: Any) -> Projector:
        driver: Projector = open_serial(board=partial(OptomaBoard, quirks=OptomaQuirks(ok=b"Ok", p_first=True))).driver
        return driver


class TestEverySerialFamily(ProjectorConformance):
    poll_s = 0.05

    @pytest.fixture(params=[name for name in BOARDS if name != "optoma-later" and baud_of(name)])
    def projector(self, request: pytest.FixtureRequest, open_serial: Any) -> Projector:
        driver: Projector = open_serial(profile=request.param).driver
        return driver


class TestEveryNetworkFamily(ProjectorConformance):
    poll_s = 0.05

    @pytest.fixture(params=[name for name in BOARDS if login_of(name)])
    def projector(self, request: pytest.FixtureRequest, open_network: Any) -> Projector:
        locked = login_of(request.param) != "none"
        settings = {"password": "secret123"} if locked else {}
        driver: Projector = open_network(
            profile=request.param, settings=settings, password="secret123" if locked else ""
        ).driver
        return driver


class TestPjLinkProjector(ProjectorConformance):
    poll_s = 0.05

    @pytest.fixture
    def projector(self, open_pjlink: Any) -> Projector:
        driver: Projector = open_pjlink(password="secret", settings={"password": "secret"}).driver
        return driver
