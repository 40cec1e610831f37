"""Both projector drivers against the shared conformance suite, over real bytes."""

from __future__ import annotations

from typing import Any

import pytest

from hal.conformance import ProjectorConformance
from hal.interfaces import Projector
from plugins.emulated.projectors.optoma import OptomaQuirks
from plugins.projectors.profile_files import shipped_profiles


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
        driver: Projector = open_serial(quirks=OptomaQuirks(ok=b"Ok", p_first=True)).driver
        return driver


class TestEverySerialFamily(ProjectorConformance):
    poll_s = 0.05

    @pytest.fixture(params=[name for name in shipped_profiles() if name not in ("optoma-later", "pjlink")])
    def projector(self, request: pytest.FixtureRequest, open_serial: Any) -> Projector:
        driver: Projector = open_serial(profile=request.param).driver
        return driver


class TestPjLinkProjector(ProjectorConformance):
    poll_s = 0.05

    @pytest.fixture
    def projector(self, open_pjlink: Any) -> Projector:
        driver: Projector = open_pjlink(password="secret", settings={"password": "secret"}).driver
        return driver
