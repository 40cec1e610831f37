"""What people change of the picture reaches a real player: brightness, another first item, black and back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from controller.core.storage import runtime_folder
from controller.kiosk.decide.interfaces import BLACK, Showing
from controller.kiosk.supervisors.player_supervisor import PlayerSupervisor
from controller.play.control.launch import PlayerSettings
from tests.controller.play.conftest import OUTPUTS, write_noise
from tests.controller.play.wire import Frames, dark, noise
from tests.waiting import wait_for


def light(frames: Frames) -> float:
    """Mean of the squared device values: nearly linear in light."""
    return float(np.mean([np.square(picture.astype(float)).mean() for picture in frames.read().values()]))


@pytest.mark.parametrize("in_turn", [False, True])
def test_brightness_and_black_reach_the_player_and_a_list_begins_where_it_should(tmp_path: Path, in_turn: bool) -> None:
    bundle = write_noise(tmp_path / "b.vel")
    frames = tmp_path / "f"
    supervisor = PlayerSupervisor(
        runtime_folder(tmp_path),
        lambda with_bundle: PlayerSettings(
            OUTPUTS, frames, bundle=bundle if with_bundle else None, allow_unsigned=True
        ),
        lambda decision: None,
    )
    turns = (("1", 60.0, 0.1), ("2", 60.0, 0.1)) if in_turn else ()

    def shows(want: Showing) -> bool:
        supervisor.want = want
        supervisor.step()
        shown = supervisor.view.shown
        return shown is not None and (shown.appearance, shown.brightness) == (want.appearance, want.brightness)

    try:
        wait_for(lambda: shows(Showing(bundle, "1", turns)))
        file = Frames(frames)
        whole = light(file)
        assert np.isclose(whole, np.mean([np.square(p.astype(float)).mean() for p in noise(OUTPUTS, 1).values()]), 0.01)
        wait_for(lambda: shows(Showing(bundle, "1", turns, brightness=0.4, fade_s=0.2)))
        assert light(file) / whole == pytest.approx(0.4, abs=0.01)
        wait_for(lambda: shows(Showing(bundle, "2", turns[::-1], brightness=0.4, fade_s=0.2)))
        supervisor.want = BLACK
        wait_for(lambda: supervisor.step() or dark(file.read()))  # type: ignore[func-returns-value]
        wait_for(lambda: shows(Showing(bundle, "1", turns)))
        assert light(file) / whole == pytest.approx(1.0)
    finally:
        supervisor.want = BLACK
        supervisor.close()
