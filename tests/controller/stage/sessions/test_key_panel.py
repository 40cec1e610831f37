"""[key_panel] in stage.toml: the technician's keys from the table to the service that serves them."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from controller.core.errors import UsageError
from controller.run.state_machine import State
from controller.stage.rig.key_panel import KeyService, technicians_keys
from controller.stage.sessions.check import check_stage
from controller.stage.sessions.open import technicians_panel
from hal.deadline import Deadline, in_seconds
from hal.registry import Driver, Drivers
from hal.values import DeviceIdentity, PanelCapabilities
from tests.controller.stage.sessions.run_models import STAGE, Models

TABLE = """
[key_panel]
driver = "model"
serial = "K1"
"""


class Panel:
    """Its third key is pressed once."""

    capabilities = PanelCapabilities(4)

    def __init__(self) -> None:
        self.open, self.pressed = True, [2]

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        return DeviceIdentity("Model", "Panel")

    def show(self, key: int, picture: npt.NDArray[np.uint8], *, deadline: Deadline) -> None:
        raise AssertionError("it has no pictures")

    def wait_pressed(self, *, deadline: Deadline) -> int | None:
        if self.pressed:
            return self.pressed.pop()
        deadline.sleep(0.02)
        return None

    def close(self) -> None:
        self.open = False


def drivers(models: Models, panel: Panel) -> Drivers:
    asked = Driver("button_panel", "model", "Keys.", lambda settings, *_: panel, {"serial": "its serial number"})
    return Drivers((*models.drivers.list, asked))


def test_a_pressed_key_reaches_its_command_and_the_panel_is_closed_afterwards(tmp_path: Path) -> None:
    models, panel, stopped = Models(tmp_path), Panel(), threading.Event()
    (tmp_path / "stage.toml").write_text(STAGE + TABLE)
    checked = check_stage(tmp_path, drivers=drivers(models, panel))
    with technicians_panel(checked, deadline=in_seconds(60)) as found:
        assert found is not None
        assert found.identity(deadline=in_seconds(60)).model == "Panel"
        keys = technicians_keys(lambda: None, stopped.set, lambda: None)
        service = KeyService(found, keys, state=lambda: State.PLAYING)
        service.start()
        assert stopped.wait(60)
        service.stop()
    assert not panel.open


def test_a_stage_without_keys_has_no_panel(tmp_path: Path) -> None:
    models = Models(tmp_path)
    with technicians_panel(check_stage(tmp_path, drivers=models.drivers), deadline=in_seconds(60)) as found:
        assert found is None


@pytest.mark.parametrize(
    ("right", "wrong", "word"),
    [('"model"\nserial', '"typewriter"\nserial', "button_panel driver"), ("serial", "cereal", "cereal")],
)
def test_a_wrong_table_is_refused_with_its_line(tmp_path: Path, right: str, wrong: str, word: str) -> None:
    models = Models(tmp_path)
    (tmp_path / "stage.toml").write_text(STAGE + TABLE.replace(right, wrong))
    with pytest.raises(UsageError) as caught:
        check_stage(tmp_path, drivers=drivers(models, Panel()))
    assert word in caught.value.what
    assert "line 2" in caught.value.what
