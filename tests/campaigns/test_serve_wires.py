from __future__ import annotations

import random
from pathlib import Path

import pytest

from tests.campaigns.serve_wires import STEPS, cases, judge
from tests.campaigns.wired_kiosk import WiredKiosk, prepare_wired

COUNT = 2
"""Of some hundred; all of them: ``python -m tests.campaigns.serve_wires``."""


@pytest.mark.timeout(900)
def test_faults_on_real_wires_end_explained_and_are_mended(tmp_path: Path) -> None:
    short = [(step, fault) for step, fault in cases() if not fault.lasts and step != "calibrating"]
    with WiredKiosk(prepare_wired(tmp_path)) as kiosk:
        for step, fault in random.Random(6).sample(short, COUNT):
            judge(kiosk, step, fault)


def test_every_emulated_devices_knobs_are_rows_of_the_matrix_at_every_step() -> None:
    names = {fault.name for _, fault in cases()}
    assert {"wire silent=True", "camera lost_events=1", "unplug of left for good", "player hung"} <= names
    assert len(cases()) == len(names) * len(STEPS)
