"""The playlist that a bundle suggests, and what a player reports of a bundle that no one signed."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from nacl.signing import SigningKey

from controller.bundle.format import PlaylistEntry
from controller.bundle.signing import write_public_key
from controller.play.control.launch import PlayerProcess
from tests.controller.play.conftest import write_noise
from tests.controller.play.wire import Frames, Wire, noise, same

Outputs = list[tuple[str, int, int]]
Start = Callable[..., PlayerProcess]
SCHEDULE = [PlaylistEntry("3", 40, 0), PlaylistEntry("1", 60, 0), PlaylistEntry("5", 3_600_000, 50)]


@pytest.fixture
def suggesting(tmp_path: Path) -> Path:
    return write_noise(tmp_path / "suggesting.vel", schedule=SCHEDULE)


def comes(frames: Frames, outputs: Outputs, seed: int) -> bool:
    """Whether this appearance comes within some seconds."""
    ends = time.monotonic() + 60
    while not (there := same(frames.read(), noise(outputs, seed))) and time.monotonic() < ends:
        time.sleep(0.005)
    return there


def test_it_is_played_with_its_times_and_fades_when_asked_for(
    start: Start, suggesting: Path, outputs: Outputs, tmp_path: Path
) -> None:
    with Wire(start(bundle=suggesting, allow_unsigned=True, rate_hz=100.0).socket) as wire:
        first = wire.ask("suggested")
        assert comes(Frames(tmp_path / "out.frame"), outputs, 5)
        status = wire.ask("status")
        assert status["sequence"] - first["sequence"] >= 3, "the two before it, and a step of its fade"
        assert status["presented_at"] - first["presented_at"] > 0.13
        assert status["sequence_running"]


def test_a_player_may_begin_with_it_and_goes_on_with_what_was_asked_for_since(
    start: Start, suggesting: Path, outputs: Outputs, tmp_path: Path
) -> None:
    player = start(bundle=suggesting, allow_unsigned=True, suggested=True, resume=True)
    shown = Frames(tmp_path / "out.frame")
    assert comes(shown, outputs, 5)
    with Wire(player.socket) as wire:
        wire.ask("play", appearance="2")
    os.kill(player.pid, signal.SIGKILL)
    player.restart()
    assert comes(shown, outputs, 2)
    with Wire(player.socket) as wire:
        wire.ask("stop")
    os.kill(player.pid, signal.SIGKILL)
    player.restart()
    with Wire(player.socket) as wire:
        assert wire.ask("status")["showing"] == "black", "stopped is stopped, after a crash as well"


def test_a_bundle_that_suggests_nothing_is_told_and_shows_black_at_the_start(start: Start, bundle: Path) -> None:
    with Wire(start(bundle=bundle, allow_unsigned=True, suggested=True).socket) as wire:
        assert wire.ask("suggested")["error"]["code"] == "bundle-no-schedule"
        assert wire.ask("status")["showing"] == "black"


def test_a_bundle_that_nobody_signed_is_refused_or_told_for_as_long_as_it_is_loaded(
    start: Start, bundle: Path, tmp_path: Path
) -> None:
    key = SigningKey(bytes(range(32)))
    signed = write_noise(tmp_path / "signed.vel", key=key)
    write_public_key(tmp_path / "ours.pub", bytes(key.verify_key))
    player = start(allow_unsigned=True, trusted=[tmp_path / "ours.pub"])
    with Wire(player.socket) as wire:
        assert wire.ask("status")["warning"] is None
        assert wire.ask("load-bundle", path=str(bundle))["ok"]
        status = wire.ask("status")
        assert (status["signed_by"], status["warning"]["code"]) == (None, "bundle-unproven")
        assert "origin is unknown" in status["warning"]["what"]
        assert wire.ask("load-bundle", path=str(signed))["ok"]
        status = wire.ask("status")
        assert (status["signed_by"], status["warning"]) == (bytes(key.verify_key).hex(), None)
    assert player.log.read_text().count("WARNING: The bundle has no signature") == 1


def test_a_key_that_is_on_no_list_proves_nothing(start: Start, tmp_path: Path) -> None:
    signed = write_noise(tmp_path / "signed.vel", key=SigningKey(bytes(32)))
    with Wire(start(bundle=signed, allow_unsigned=True).socket) as wire:
        assert "a key that stage.toml does not list" in wire.ask("status")["warning"]["what"]
