"""A player whose disk is full, whose process was stopped for a while, whose clock is set, whose X server is gone."""

from __future__ import annotations

import ast
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import controller.play
from controller.play.control.launch import PlayerProcess, PlayerSettings, start_player
from tests.controller.play.display.xorg import HEIGHT, WIDTH, running_server
from tests.controller.play.wire import Frames, Wire, noise, same

Outputs = list[tuple[str, int, int]]
Start = Callable[..., PlayerProcess]


def test_a_disk_that_is_full_at_the_start_is_told(tmp_path: Path) -> None:
    player = [sys.executable, "-m", "controller.play", "--socket", str(tmp_path / "s"), "--outputs", "P1:400x300"]
    command = ["prlimit", "--fsize=8192", *player, "--frames", str(tmp_path / "f")]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
    assert ended.returncode == 1
    assert "disk has no space for s.inbox" in ended.stderr
    assert not [path for path in tmp_path.iterdir() if path.suffix != ".lock"], "nothing half made stays"


def test_a_disk_that_becomes_full_stops_no_picture(
    start: Start, bundle: Path, outputs: Outputs, tmp_path: Path
) -> None:
    player = start(bundle=bundle, allow_unsigned=True, resume=True)
    shown = Frames(tmp_path / "out.frame")
    with Wire(player.socket) as wire:
        inbox = Frames(Path(wire.ask("hello")["inbox"]))
        # No file of this process may grow any more. Its log is one, too.
        resource.prlimit(player.pid, resource.RLIMIT_FSIZE, (0, 0))
        for seed in range(4):
            assert wire.ask("play", appearance=str(seed))["ok"]
            assert same(shown.read(), noise(outputs, seed))
            assert wire.ask("show", sequence=inbox.write(noise(outputs, 60 + seed)))["ok"]
            assert same(shown.read(), noise(outputs, 60 + seed))
    assert player.alive


def test_a_player_that_was_stopped_for_a_while_goes_on_with_whole_pictures(
    start: Start, bundle: Path, outputs: Outputs, tmp_path: Path
) -> None:
    player = start(bundle=bundle, allow_unsigned=True)
    shown, expected = Frames(tmp_path / "out.frame"), [noise(outputs, seed) for seed in range(6)]
    with Wire(player.socket) as wire:
        wire.ask("sequence", items=[[str(seed), 0.02, 0.0] for seed in range(6)])
        for _ in range(3):
            os.kill(player.pid, signal.SIGSTOP)
            time.sleep(0.15)
            before = shown.sequence
            os.kill(player.pid, signal.SIGCONT)
            ends = time.monotonic() + 60
            while shown.sequence < before + 8 and time.monotonic() < ends:
                now = shown.read()
                assert sum(same(now, one) for one in expected) == 1
            assert shown.sequence >= before + 8
        assert wire.ask("status")["late"] >= 1


def test_the_wall_clock_means_nothing_to_the_player() -> None:
    for path in Path(controller.play.__path__[0]).glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "time":
                assert node.attr in ("monotonic", "sleep"), f"{path.name} asks for time.{node.attr}"
            assert not (isinstance(node, ast.Name) and node.id == "datetime")


def test_a_player_ends_with_its_x_server_and_starts_on_the_next(tmp_path: Path) -> None:
    settings = PlayerSettings([("P1", WIDTH, HEIGHT)], None, where={"P1": "DUMMY0"})
    with running_server(tmp_path):
        player = start_player(tmp_path, settings)
    ends = time.monotonic() + 60
    while player.alive and time.monotonic() < ends:
        time.sleep(0.02)
    assert not player.alive
    with running_server(tmp_path) as outputs:
        player.restart()
        with Wire(player.socket) as wire:
            assert wire.ask("identify")["ok"]
            assert outputs.picture(0)[0].all()
        assert player.terminate() == 0
