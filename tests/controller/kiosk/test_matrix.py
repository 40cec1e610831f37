from __future__ import annotations

from pathlib import Path

import pytest

from tests.controller.kiosk.matrix import Fault, cases, judge
from tests.controller.kiosk.model import Kiosk

ALL = list(cases())[::6]
"""A sixth of the matrix, another fault at each step; all of it: ``python -m tests.campaigns.serve_matrix``."""


@pytest.mark.parametrize(("step", "fault"), ALL, ids=[f"{step}-{fault.name}" for step, fault in ALL])
def test_every_fault_at_every_step_ends_explained_and_is_mended(tmp_path: Path, step: str, fault: Fault) -> None:
    judge(Kiosk(tmp_path), step, fault)
