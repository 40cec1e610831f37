"""A bundle that no one signed, on a stage that allows it: the service hears it from its player, and says it on."""

from __future__ import annotations

from pathlib import Path

import pytest
from nacl.signing import SigningKey

from controller.bundle.signing import write_public_key
from controller.core.storage import runtime_folder
from controller.kiosk.supervisors.player_supervisor import PlayerSupervisor
from controller.play.control.launch import PlayerSettings
from hal.notices import Notice
from tests.controller.play.conftest import OUTPUTS, write_noise


@pytest.mark.parametrize("signed", [False, True])
def test_the_keeper_tells_it_once_and_shows_it_as_long_as_it_plays(tmp_path: Path, signed: bool) -> None:
    key = SigningKey(bytes(range(32)))
    write_public_key(tmp_path / "ours.pub", bytes(key.verify_key))
    bundle = write_noise(tmp_path / "b.vel", key=key if signed else None)
    settings = PlayerSettings(
        OUTPUTS, tmp_path / "f", bundle=bundle, trusted=[tmp_path / "ours.pub"], allow_unsigned=True
    )
    told: list[Notice] = []
    supervisor = PlayerSupervisor(runtime_folder(tmp_path), lambda plays: settings, told.append)
    try:
        for _ in range(5):
            supervisor.step()
    finally:
        supervisor.close()
    warnings = [one for one in told if one.level == "warning"]
    if signed:
        assert (warnings, supervisor.view.warning) == ([], None)
    else:
        assert warnings == [supervisor.view.warning]
        assert "origin is unknown" in warnings[0].text
        assert "velatura bundle key" in warnings[0].remedy
