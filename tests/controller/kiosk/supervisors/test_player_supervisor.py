"""What the player's supervisor does while a service ends; the rest is in the tests of the player, and of the kiosk."""

from __future__ import annotations

from pathlib import Path

import pytest

from controller.kiosk.supervisors import player_supervisor as player_keeper
from controller.kiosk.supervisors.player_supervisor import PlayerSupervisor
from controller.play.control.launch import PlayerSettings


class ModelProcess:
    """A player as its starter sees it."""

    def __init__(self, runtime: Path, settings: PlayerSettings) -> None:
        self.alive = True
        running.append(self)

    def wait_until_ready(self, timeout_s: float) -> dict[str, object]:
        return {"bundle": None}

    def terminate(self) -> None:
        self.alive = False


running: list[ModelProcess] = []


def test_a_player_that_starts_after_its_keeper_was_closed_is_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(player_keeper, "PlayerProcess", ModelProcess)

    def settings(with_bundle: bool) -> PlayerSettings:
        supervisor.close()  # the service ends while the start is prepared
        return PlayerSettings([("P1", 8, 8)], tmp_path / "outputs.frame")

    supervisor = PlayerSupervisor(tmp_path, settings, lambda _: None)
    supervisor.step()
    assert [process.alive for process in running] == [False]
