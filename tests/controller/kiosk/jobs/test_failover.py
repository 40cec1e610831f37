"""When nothing is solved for the projectors that are left; that they do take over is tested on a real calibration."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from controller.core.errors import VelaturaError
from controller.kiosk.jobs.failover import solve_without
from controller.run.progress import Silent
from controller.stage.sessions.session import BorrowedSession
from tests.controller.kiosk.vase import TEXT, vase

RIGHT = """
[[projectors]]
name = "right"
output = "P2"
driver = "serial"
port = "/dev/ttyUSB1"
profile = "optoma-later"

[[display.outputs]]
name = "P2"
width_px = 1400
height_px = 1050

[[appearances]]"""
NOBODY, UNKNOWN = "no-projector-left", "not-calibrated"


@pytest.mark.parametrize(
    ("missing", "code"), [(("left", "right"), NOBODY), ((), NOBODY), (("nobody",), NOBODY), (("left",), UNKNOWN)]
)
def test_nothing_is_solved_for_nobody_and_nothing_without_a_calibration(
    tmp_path: Path, missing: tuple[str, ...], code: str
) -> None:
    stage = vase(tmp_path)
    (stage / "stage.toml").write_text(TEXT.replace("\n[[appearances]]", RIGHT, 1))
    with pytest.raises(VelaturaError) as caught:
        solve_without(BorrowedSession(stage), missing, reporter=Silent(), cancel=threading.Event())
    assert caught.value.code == code
    assert not {"runs", "bundles-without"} & {path.name for path in stage.iterdir()}
