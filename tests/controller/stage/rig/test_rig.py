from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hal.errors import DeviceGone, DeviceRefused
from hal.values import Power, ProjectorStatus
from tests.controller.stage.rig.lamp_model import soon
from tests.controller.stage.rig.rig_model import SIZE_PX, ModelRig


def test_a_projector_that_is_not_named_shows_black(tmp_path: Path) -> None:
    rig = ModelRig(tmp_path).rig
    white = np.full((SIZE_PX[1], SIZE_PX[0], 3), 255, np.uint8)
    frames = rig.on_outputs({"right": white})
    assert frames.keys() == {"P1", "P2"}
    assert not frames["P1"].any()
    assert frames["P1"].shape == white.shape
    assert (frames["P2"] == 255).all()


def test_lit_and_steady_lamps_pass(tmp_path: Path) -> None:
    ModelRig(tmp_path).rig.check_light(deadline=soon())


def test_a_lamp_that_went_off_is_named(tmp_path: Path) -> None:
    stage = ModelRig(tmp_path)
    stage.lamps["right"].go_dark()
    with pytest.raises(DeviceRefused, match="right went off") as refused:
        stage.rig.check_light(deadline=soon())
    assert refused.value.code == "lamp-went-off"
    assert "start the same command or job again: it continues" in refused.value.remedy


def test_a_lamp_that_went_off_and_was_struck_again_is_not_steady_yet(tmp_path: Path) -> None:
    stage = ModelRig(tmp_path)
    stage.lamps["left"].go_dark()
    guard = stage.rig.guards[0]
    guard.status(deadline=soon())
    stage.lamps["left"].strike(sin=False)
    stage.world.time_s += 3
    with pytest.raises(DeviceRefused, match="left"):
        stage.rig.check_light(deadline=soon())


def test_a_fault_is_told_as_the_projector_calls_it(tmp_path: Path) -> None:
    stage = ModelRig(tmp_path)
    stage.lamps["left"].reports = ProjectorStatus(Power.FAULT, ("lamp-failed",))
    with pytest.raises(DeviceRefused, match="lamp-failed") as refused:
        stage.rig.check_light(deadline=soon())
    assert "start the same command or job again: it continues" in refused.value.remedy


def test_a_projector_that_is_gone_is_not_taken_for_lit(tmp_path: Path) -> None:
    stage = ModelRig(tmp_path)
    stage.lamps["left"].trouble = "gone"
    with pytest.raises(DeviceGone):
        stage.rig.check_light(deadline=soon())
