"""What the player's supervisor does while a service ends; the rest is in the tests of the player, and of the kiosk."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, cast

import pytest

from controller.kiosk import world as player_starts
from controller.kiosk.decide.interfaces import Showing
from controller.kiosk.supervisors.player_supervisor import PlayerSupervisor
from controller.play.control.launch import PlayerSettings
from hal.notices import Notice
from hal.player import PlayerClient


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
    monkeypatch.setattr(player_starts, "PlayerProcess", ModelProcess)

    def settings(with_bundle: bool) -> PlayerSettings:
        supervisor.close()  # the service ends while the start is prepared
        return PlayerSettings([("P1", 8, 8)], tmp_path / "outputs.frame")

    supervisor = PlayerSupervisor(tmp_path, settings, lambda _: None)
    supervisor.step()
    assert [process.alive for process in running] == [False]


class Refusing:
    """The socket of a player whose bundle is damaged; ``missing``: its outputs without a picture."""

    def __init__(self) -> None:
        self.missing: list[str] = []
        self._answer = b""

    def settimeout(self, seconds: float) -> None:
        """It answers at once."""

    def close(self) -> None:
        """Nothing to release."""

    def sendall(self, data: bytes) -> None:
        request = json.loads(data)
        answer: dict[str, Any] = {"id": request["id"], "ok": False, "error": {
            "code": "bundle-damaged", "what": "The bundle is damaged.", "remedy": "Publish it again."}}  # fmt: skip
        if request["op"] == "status":
            answer = {"id": request["id"], "ok": True, "bundle": None, "showing": "black", "appearance": None,
                      "brightness": 1.0, "sequence_running": False, "skipped": 0,
                      "missing_outputs": self.missing}  # fmt: skip
        self._answer = json.dumps(answer).encode() + b"\n"

    def recv(self, _: int) -> bytes:
        return self._answer


class ReadyProcess(ModelProcess):
    socket = Path("player.sock")

    def kill(self) -> None:
        self.alive = False


def test_an_output_without_a_picture_is_told_beside_a_damaged_bundle(tmp_path: Path) -> None:
    wire, told, now_s = Refusing(), list[Notice](), [0.0]
    supervisor = PlayerSupervisor(
        tmp_path, lambda _: PlayerSettings([("P1", 8, 8), ("P2", 8, 8)], tmp_path / "outputs.frame"), told.append,
        monotonic=lambda: now_s[0], launch=lambda runtime, settings: cast("Any", ReadyProcess(runtime, settings)),
        channel=PlayerClient(lambda *_: cast("Any", wire)),
    )  # fmt: skip
    supervisor.want = Showing(tmp_path / "b.vel", "1")
    supervisor.identifying = False
    for _ in range(60):
        # After starts that show nothing, one runs without the bundle, and answers.
        supervisor.step()
        now_s[0] += 5.0
        if not supervisor._run.with_bundle:
            break
    wire.missing = ["P2"]
    supervisor.step()
    problem, outputs = supervisor.view.problem, supervisor.view.outputs
    assert problem is not None
    assert outputs is not None
    assert problem.code == "bundle-damaged"
    assert "The bundle is damaged." in problem.what
    assert "P2" in problem.what
    assert "cable" in problem.remedy
    supervisor.step()
    assert [one.code for one in told].count("output-gone") == 1
    wire.missing = []
    supervisor.step()
    assert supervisor.view.problem is not None
    assert supervisor.view.problem.what == "The bundle is damaged."
