"""Devices that a kiosk lends to work, and what is said when one leaves meanwhile."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import pytest

from controller.checking import check_stage
from controller.serve import projector_keeper
from controller.serve.devices import Devices
from controller.serve.eventlog import Decision
from hal.deadline import Deadline
from hal.errors import DeviceGone
from hal.values import ProjectorStatus
from tests.controller.test_app import Models, QuickLamp


@pytest.fixture
def models(tmp_path: Path) -> Models:
    return Models(tmp_path)


@pytest.fixture
def devices(models: Models, tmp_path: Path) -> Iterator[Devices]:
    told: list[Decision] = []
    found = Devices(check_stage(models.folder, drivers=models.drivers), tmp_path, told.append)
    found.camera.step()
    for keeper in found.projectors:
        keeper.step()
    with contextlib.closing(found):
        yield found


def test_work_whose_projector_is_lost_meanwhile_says_which_and_not_that_somebody_closed_it(
    devices: Devices, models: Models, monkeypatch: pytest.MonkeyPatch
) -> None:
    def silent(lamp: QuickLamp, *, deadline: Deadline) -> ProjectorStatus:
        raise DeviceGone("port-gone", what="The port went away.", remedy="Plug it in.")

    def closed() -> DeviceGone:
        return DeviceGone("projector-closed", what="The projector at A is no longer open.", remedy="Open the stage.")

    monkeypatch.setattr(projector_keeper, "PATIENCE_S", 0.0)
    with pytest.raises(DeviceGone, match="no longer open"), devices.lent():
        raise closed()
    with pytest.raises(DeviceGone) as caught, devices.lent():  # noqa: PT012 - the keeper works meanwhile
        monkeypatch.setattr(QuickLamp, "status", silent)
        devices.projectors[0].step()
        assert not models.lamps["A"].open
        raise closed()
    assert caught.value.code == "device-missing"
    assert "without projector left" in caught.value.what
    assert "Mend it" in caught.value.remedy
