"""A served panel for the tests that change nothing another test looks at, and a fresh one for the others."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.controller.panel.memory_kiosk import MemoryKiosk
from tests.controller.panel.served import Served, served


@pytest.fixture(scope="module")
def panel(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("panel")
    with served(MemoryKiosk(folder / "pictures"), folder / "private") as running:
        yield running


@pytest.fixture
def fresh(tmp_path: Path) -> Iterator[Served]:
    with served(MemoryKiosk(tmp_path / "pictures"), tmp_path / "private") as running:
        yield running
