"""A player that somebody else starts, as systemd does, and the service that is attached to it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from controller.core.errors import WorkError
from controller.kiosk.supervisors.player_supervisor import PlayerSupervisor
from controller.play.control.launch import AttachedPlayer, PlayerSettings, hello
from hal.notices import Notice
from tests.controller.play.conftest import OUTPUTS
from tests.controller.play.wire import Wire
from tests.waiting import wait_for


class Starter:
    """As systemd: starts the player with the arguments in a file, again whenever it ended."""

    def __init__(self, folder: Path) -> None:
        self.socket, self.options = folder / "player.sock", folder / "player.options"
        self.starts = 0
        self._ended = threading.Event()
        self._process: subprocess.Popen[bytes] | None = None
        self._thread = threading.Thread(target=self._run)

    def start(self) -> None:
        self._thread.start()

    def _run(self) -> None:
        while not self._ended.wait(0.05):
            self.starts += 1
            command = ["-m", "controller.play", "--socket", str(self.socket), "--resume", f"@{self.options}"]
            self._process = subprocess.Popen([sys.executable, *command])
            self._process.wait()

    def stop(self) -> None:
        self._ended.set()
        if self._thread.is_alive():
            while self._thread.is_alive():
                if self._process is not None:
                    self._process.kill()
                self._thread.join(0.1)


@pytest.fixture
def starter(tmp_path: Path) -> Iterator[Starter]:
    made = Starter(tmp_path)
    made.options.write_text(written(settings(tmp_path)))
    made.start()
    try:
        wait_for(made.socket.exists)
        yield made
    finally:
        made.stop()


def settings(folder: Path, outputs: int = 3) -> PlayerSettings:
    return PlayerSettings(OUTPUTS[:outputs], folder / "out.frame")


def written(settings: PlayerSettings) -> str:
    return "".join(f"{word}\n" for word in settings.arguments())


def test_settings_that_are_there_already_leave_the_player_alone(starter: Starter, tmp_path: Path) -> None:
    player = AttachedPlayer(starter.socket, starter.options, settings(tmp_path))
    answer = player.wait_until_ready()
    assert (player.alive, player.pid) == (True, answer["pid"])
    player.terminate()
    assert not player.alive
    assert hello(starter.socket, 5.0)["pid"] == answer["pid"], "it plays on"
    assert starter.starts == 1


def test_other_settings_are_written_and_the_player_starts_with_them(starter: Starter, tmp_path: Path) -> None:
    before = hello(starter.socket, 5.0)["pid"]
    player = AttachedPlayer(starter.socket, starter.options, settings(tmp_path, outputs=1))
    answer = player.wait_until_ready()
    assert answer["pid"] != before
    assert [row["name"] for row in answer["outputs"]] == [OUTPUTS[0][0]]
    assert starter.options.read_text() == written(settings(tmp_path, outputs=1))
    player.terminate()


def test_its_end_is_noticed_and_the_keeper_goes_on_with_the_next_one(starter: Starter, tmp_path: Path) -> None:
    told: list[Notice] = []
    wanted = settings(tmp_path)

    def attach(chosen: PlayerSettings) -> AttachedPlayer:
        return AttachedPlayer(starter.socket, starter.options, chosen)

    supervisor = PlayerSupervisor(tmp_path, lambda _: wanted, told.append, attach=attach)
    supervisor.step()
    os.kill(hello(starter.socket, 5.0)["pid"], signal.SIGKILL)

    def started_again() -> bool:
        supervisor.step()
        return [one.code for one in told].count("player-started") == 2

    wait_for(started_again)
    assert [one.code for one in told] == ["player-started", "player-died", "player-started"]
    assert starter.starts == 2
    supervisor.close()


def test_a_service_that_ends_leaves_the_player_black(starter: Starter, tmp_path: Path) -> None:
    supervisor = PlayerSupervisor(
        tmp_path,
        lambda _: settings(tmp_path),
        lambda _: None,
        attach=lambda chosen: AttachedPlayer(starter.socket, starter.options, chosen),
    )
    supervisor.step()
    with Wire(starter.socket) as wire:
        wire.ask("identify")
        supervisor.close()
        assert wire.ask("status")["showing"] == "black"
    assert starter.starts == 1


def test_where_none_is_started_the_journal_is_named(tmp_path: Path) -> None:
    player = AttachedPlayer(tmp_path / "player.sock", tmp_path / "player.options", settings(tmp_path))
    with pytest.raises(WorkError, match="journalctl") as caught:
        player.wait_until_ready(0.2)
    assert caught.value.code == "player-not-started"
