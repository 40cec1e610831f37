"""How a player starts, ends, is killed, hangs and is watched."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from controller.core.errors import WorkError
from controller.play.control.launch import PlayerProcess
from tests.controller.play.wire import Frames, Wire, dark, noise, same

Outputs = list[tuple[str, int, int]]
Start = Callable[..., PlayerProcess]


def test_clients_that_vanish_or_do_not_listen_or_are_too_many_do_no_harm(wire: Wire, folder: Path) -> None:
    for _ in range(30):
        with Wire(folder / "player.sock") as other:
            other.send(b'{"op": "play", "appearance": "2"}\n{"op": "sta')
    with Wire(folder / "player.sock") as deaf:
        deaf.channel.settimeout(0.2)
        try:
            for _ in range(200):
                deaf.send(b'{"op": "status"}\n' * 500)
        except OSError:
            pass  # the player gave it up
        assert wire.ask("status")["ok"]
    many = [Wire(folder / "player.sock") for _ in range(20)]
    assert wire.ask("hello")["ok"]
    assert many[-1].receive()["error"]["code"] == "player-busy"
    for other in many:
        other.__exit__()
    assert wire.ask("stop")["ok"]


def exit_code(player: PlayerProcess) -> int:
    """With what a player ended by itself."""
    ends = time.monotonic() + 60
    while player.alive and time.monotonic() < ends:
        time.sleep(0.01)
    return player.terminate()


def quiet(player: PlayerProcess) -> bool:
    """Whether its log holds nothing but that its bundle is not signed."""
    (line,) = player.log.read_text().splitlines()
    return line.startswith("WARNING: The bundle has no signature")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_leaves_black_and_no_socket(start: Start, bundle: Path, tmp_path: Path, number: int) -> None:
    player = start(bundle=bundle, allow_unsigned=True)
    with Wire(player.socket) as wire:
        wire.ask("sequence", items=[["1", 0.05], ["2", 0.05]])
        os.kill(player.pid, number)
    assert exit_code(player) == 0
    assert dark(Frames(tmp_path / "out.frame").read())
    assert not player.socket.exists()
    assert quiet(player)


def test_quit_is_answered_and_ends_it(start: Start, bundle: Path, tmp_path: Path) -> None:
    player = start(bundle=bundle, allow_unsigned=True)
    with Wire(player.socket) as wire:
        wire.ask("play", appearance="1")
        assert wire.ask("quit")["ok"]
        assert wire.ended()
    assert exit_code(player) == 0
    assert dark(Frames(tmp_path / "out.frame").read())


def test_a_killed_player_is_restarted_over_its_stale_socket_and_readers_see_it_go_on(
    start: Start, bundle: Path, outputs: Outputs, tmp_path: Path
) -> None:
    player = start(bundle=bundle, allow_unsigned=True)
    shown = Frames(tmp_path / "out.frame")
    with Wire(player.socket) as wire:
        wire.ask("play", appearance="1")
    before = shown.sequence
    os.kill(player.pid, signal.SIGKILL)
    assert player.socket.exists()
    player.restart()
    with Wire(player.socket) as wire:
        wire.ask("play", appearance="2")
    assert shown.sequence > before
    assert same(shown.read(), noise(outputs, 2)), "a reader that had the file mapped sees the new player"


def test_a_killed_player_goes_on_with_what_it_played(
    start: Start, bundle: Path, outputs: Outputs, tmp_path: Path
) -> None:
    player = start(bundle=bundle, allow_unsigned=True, resume=True)
    with Wire(player.socket) as wire:
        wire.ask("sequence", items=[["4", 60], ["5", 60]])
    os.kill(player.pid, signal.SIGKILL)
    began = time.monotonic()
    player.restart()
    shown = Frames(tmp_path / "out.frame")
    while not same(shown.read(), noise(outputs, 4)):
        assert time.monotonic() < began + 5
    with Wire(player.socket) as wire:
        wire.ask("stop")
    player.restart()
    with Wire(player.socket) as wire:
        assert wire.ask("status")["showing"] == "black"


@pytest.mark.parametrize("kept", [b"", b"{", b'{"op":"quit"}', b'{"op":"play","appearance":"gone"}'])
def test_what_can_not_be_gone_on_with_is_left(start: Start, bundle: Path, tmp_path: Path, kept: bytes) -> None:
    (tmp_path / "player.sock.playing").write_bytes(kept)
    with Wire(start(bundle=bundle, allow_unsigned=True, resume=True).socket) as wire:
        assert wire.ask("status")["showing"] == "black"


def test_a_hung_player_is_restarted(start: Start) -> None:
    player = start()
    os.kill(player.pid, signal.SIGSTOP)
    hello = player.restart()
    assert hello["pid"] == player.pid


def run_player(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "controller.play", "--socket", str(folder / "player.sock"), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)


def test_a_second_player_does_not_start_and_the_first_goes_on(wire: Wire, folder: Path) -> None:
    frames = ["--outputs", "P1:8x8", "--frames"]
    second = run_player(folder, *frames, str(folder / "other.frame"))
    assert second.returncode == 2
    assert "already running" in second.stderr
    (folder / "deeper").mkdir()
    third = run_player(
        folder / "deeper", "--outputs", "P1:40x30,P2:41x31,Prój3:39x29", "--frames", str(folder / "out.frame")
    )
    assert third.returncode == 2
    assert "Another player writes" in third.stderr
    assert wire.ask("stop")["ok"]


@pytest.mark.parametrize(
    ("arguments", "code", "sentence"),
    [
        (["--outputs", "P1:0x8", "--frames", "f"], 2, "a side is not"),
        (["--outputs", "P1:8x8,P1:8x8", "--frames", "f"], 2, "same name"),
        (["--outputs", "P1", "--frames", "f"], 2, "NAME:WIDTHxHEIGHT"),
        (["--outputs", "P1:8x8", "--frames", "f", "--rate", "0"], 2, "rate"),
        (["--outputs", "P1:8x8", "--frames", "f", "--rate", "nan"], 2, "rate"),
        (["--outputs", "P1:8x8", "--frames", "f", "--trusted", "/nowhere"], 2, "key file"),
        (["--outputs", "P1:8x8", "--frames", "/proc/f"], 1, "could not be written"),
        (["--outputs", "P1:8x8", "--frames", "f", "--bundle", "/nowhere"], 1, "can't be read"),
    ],
)
def test_a_wrong_start_says_what_and_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], code: int, sentence: str
) -> None:
    arguments = [str(tmp_path / "f") if argument == "f" else argument for argument in arguments]
    ended = run_player(tmp_path, *arguments)
    assert ended.returncode == code
    assert sentence in ended.stderr
    assert len(ended.stderr.splitlines()) == 2, "one sentence on what happened, one on what to do"
    assert not (tmp_path / "player.sock").exists()


def test_a_player_that_does_not_start_is_told_with_its_reason(start: Start) -> None:
    with pytest.raises(WorkError, match=r"/nowhere/b\.vel can't be read") as caught:
        start(bundle=Path("/nowhere/b.vel"))
    assert caught.value.code == "player-not-started"


def test_systemd_hears_ready_alive_and_stopping(start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        systemd.settimeout(10)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        monkeypatch.setenv("WATCHDOG_USEC", "300000")
        player = start()
        assert systemd.recv(99) == b"READY=1"
        moments = []
        for _ in range(3):
            assert systemd.recv(99) == b"WATCHDOG=1"
            moments.append(time.monotonic())
        assert moments[-1] - moments[0] < 2 * 0.3
        player.terminate()
        while (state := systemd.recv(99)) == b"WATCHDOG=1":
            pass
        assert state == b"STOPPING=1"


def test_starting_loads_neither_the_window_library_nor_the_rest_of_the_controller() -> None:
    program = "import sys, controller.play.__main__; print(*sys.modules)"
    modules = set(
        subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split()
    )
    heavy = {
        "pyglet", "scipy", "numba", "cv2", "pydantic", "typer", "rich", "controller.stage.sessions.run",
        "controller.config", "hal.deadline", "hal.interfaces", "hal.registry",
    }  # fmt: skip
    assert not heavy & modules
