from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from controller.core.errors import UsageError
from controller.stage.doctor.examine import Tools
from controller.stage.services.setup import set_up
from controller.stage.sessions.check import check_stage
from hal.deadline import Deadline
from hal.finding import Finder, Found, SearchScope
from hal.registry import load_drivers

OUTPUT = {"name": "P1", "width_px": 1400, "height_px": 1050}
FOUND = (
    Found(
        "serial", "/dev/ttyUSB0", "Optoma", "projector", "serial", {"port": "/dev/ttyUSB0", "profile": "optoma-later"}
    ),
    Found("usb", "001:004", "Camera", "camera", "ptp", {"address": "ptpip:127.0.0.1"}),
    Found("x11", "P1", "Output", "display", "player", {"outputs": [OUTPUT]}),
)


def tools(*found: Found) -> Tools:
    def find(wanted: SearchScope, deadline: Deadline) -> Sequence[Found]:
        return found

    return Tools(finders=(Finder("model", find),), drivers=load_drivers())


def test_what_is_plugged_in_becomes_a_stage_with_a_key_that_it_trusts(tmp_path: Path) -> None:
    folder = tmp_path / "vase"
    set_up(folder, name="The vase", focal_length_px=4100.0, ask=lambda question, one: "left", tools=tools(*FOUND))
    tables = check_stage(folder).stage.tables
    assert tables.stage.name == "The vase"
    assert [one.name for one in tables.projectors] == ["left"]
    assert len(tables.bundle.trusted_keys) == 1
    with pytest.raises(UsageError, match="already"):
        set_up(folder, name=None, focal_length_px=None, ask=lambda question, one: one, tools=tools(*FOUND))


def test_answers_that_make_no_stage_leave_nothing_behind(tmp_path: Path) -> None:
    with pytest.raises(UsageError):
        set_up(tmp_path, name="a/b", focal_length_px=4100.0, ask=lambda question, one: one, tools=tools(*FOUND))
    assert list(tmp_path.iterdir()) == []


def test_too_little_is_told(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="a camera"):
        set_up(tmp_path, name="x", focal_length_px=1.0, ask=lambda question, one: one, tools=tools(FOUND[0]))
