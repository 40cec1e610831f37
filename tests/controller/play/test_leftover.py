"""A player whose starter was killed."""

from __future__ import annotations

import os
import signal
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from controller.core.errors import WorkError
from controller.play.control import launch
from controller.play.control.launch import PlayerProcess, PlayerSettings, end_leftover, replace_player


@pytest.mark.parametrize("hangs", [False, True])
def test_it_is_ended_even_if_it_hangs_and_another_can_start(
    start: Callable[..., PlayerProcess], tmp_path: Path, hangs: bool
) -> None:
    left = start()
    if hangs:
        os.kill(left.pid, signal.SIGSTOP)
    assert end_leftover(tmp_path, timeout_s=0.5 if hangs else 10.0)
    assert not left.alive
    assert start().alive


def test_where_none_serves_nothing_happens(tmp_path: Path) -> None:
    assert not end_leftover(tmp_path)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(str(tmp_path / "player.sock"))  # no one listens: its player is dead
    assert not end_leftover(tmp_path)


def test_one_that_was_still_loading_when_it_was_looked_for_is_replaced_all_the_same(
    start: Callable[..., PlayerProcess], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = start()
    looks = iter([False])  # the first look finds no one, as while it loads
    monkeypatch.setattr(launch, "end_leftover", lambda runtime: next(looks, None) is None and end_leftover(runtime))
    with replace_player(tmp_path, PlayerSettings([("P1", 64, 48)], tmp_path / "other.frame")) as player:
        assert player.alive
        assert not left.alive


def test_a_socket_that_stays_taken_is_not_waited_for_longer_than_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks = iter(range(100))

    def taken(runtime: Path, settings: PlayerSettings, *, timeout_s: float) -> PlayerProcess:
        raise WorkError("player-not-started", what=f"It says: {launch._TAKEN}", remedy="End the other one.")

    def none_left(runtime: Path) -> bool:
        assert next(looks, None) is not None, "it looks for ever"
        return False

    monkeypatch.setattr(launch, "start_player", taken)
    monkeypatch.setattr(launch, "end_leftover", none_left)
    with pytest.raises(WorkError):
        replace_player(tmp_path, PlayerSettings([("P1", 64, 48)], tmp_path / "frame"), timeout_s=0.05)
