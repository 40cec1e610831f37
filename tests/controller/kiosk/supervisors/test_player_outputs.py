"""An output of a real X server that goes while a real player plays: it is said, and that it is back."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from controller.core.storage import runtime_folder
from controller.kiosk.decide.interfaces import Showing
from controller.kiosk.supervisors.player_supervisor import PlayerSupervisor
from controller.play.control.launch import PlayerSettings
from hal.notices import Notice
from tests.controller.play.conftest import write_noise
from tests.controller.play.display.xorg import CONNECTORS, HEIGHT, WIDTH, running_server
from tests.controller.play.wire import noise
from tests.waiting import wait_for

SIZES = [(name, WIDTH, HEIGHT) for name in ("P1", "P2", "P3")]
WHERE = dict(zip(("P1", "P2", "P3"), CONNECTORS, strict=True))


def test_an_output_that_is_away_is_told_once_and_the_others_play_until_it_is_back(tmp_path: Path) -> None:
    bundle = write_noise(tmp_path / "b.vel", outputs=SIZES)
    told: list[Notice] = []
    settings = PlayerSettings(SIZES, None, bundle=bundle, allow_unsigned=True, where=WHERE)
    with running_server(tmp_path) as server:
        supervisor = PlayerSupervisor(runtime_folder(tmp_path), lambda _: settings, told.append)
        supervisor.want = Showing(bundle, "1")

        def problem() -> str:
            supervisor.step()
            return "" if supervisor.view.problem is None else supervisor.view.problem.code

        try:
            server.xrandr("--output", CONNECTORS[1], "--off")
            wait_for(lambda: problem() == "output-gone" and supervisor.view.shown == supervisor.want)
            assert np.array_equal(server.picture(0), noise(SIZES, 1)["P1"])
            server.place(CONNECTORS[1], WIDTH)
            wait_for(lambda: problem() == "")
            assert np.array_equal(server.picture(WIDTH), noise(SIZES, 1)["P2"])
            server.xrandr("--output", CONNECTORS[0], "--off", "--output", CONNECTORS[2], "--off")
            wait_for(lambda: problem() == "output-gone" and "P1, P3" in told[-1].text)
        finally:
            supervisor.close()
    codes = [one.code for one in told if one.code in ("output-gone", "player-well", "player-died")]
    assert codes == ["output-gone", "player-well", "output-gone"]
    assert "P2" in next(one.text for one in told if one.code == "output-gone")
