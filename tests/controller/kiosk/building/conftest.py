"""The kiosk that the building's protocols drive."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.controller.panel.memory_kiosk import MemoryKiosk


@pytest.fixture
def kiosk(tmp_path: Path) -> Iterator[MemoryKiosk]:
    made = MemoryKiosk(tmp_path / "pictures")
    yield made
    made.close()
