"""The player as a process of its own, seen through its socket and its memory output only."""

from __future__ import annotations

import os
import signal
import socket
import stat
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controller.bundle.signing import generate_key, load_signing_key
from controller.bundle.writer import NewAppearance, write_bundle
from controller.errors import WorkError
from controller.play.launch import PlayerProcess
from tests.controller.play.wire import Frames, Pictures, Wire, noise

Outputs = list[tuple[str, int, int]]
Start = Callable[..., PlayerProcess]


def same(found: Pictures, expected: Pictures) -> bool:
    return found.keys() == expected.keys() and all(np.array_equal(found[name], expected[name]) for name in found)


def dark(pictures: Pictures) -> bool:
    return not any(picture.any() for picture in pictures.values())


def test_it_says_who_it_is_and_begins_black(wire: Wire, outputs: Outputs, folder: Path) -> None:
    hello = wire.ask("hello")
    assert hello["ok"] is True
    assert hello["protocol"] == 1
    assert [(o["name"], o["width_px"], o["height_px"]) for o in hello["outputs"]] == outputs
    assert dark(Frames(folder / "out.frame").read())
    for path in (folder / "player.sock", Path(hello["inbox"]), folder / "out.frame"):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_a_pattern_appears_byte_for_byte_and_the_answer_comes_after_it(
    wire: Wire, outputs: Outputs, folder: Path
) -> None:
    shown, inbox = Frames(folder / "out.frame"), Frames(Path(wire.ask("hello")["inbox"]))
    last = 0.0
    for seed in range(100, 105):
        pattern = noise(outputs, seed)
        asked = time.monotonic()
        answer = wire.ask("show", sequence=inbox.write(pattern))
        assert same(shown.read(), pattern)
        assert asked <= answer["presented_at"] <= time.monotonic()
        assert shown.presented_at == answer["presented_at"] > last
        last = answer["presented_at"]
    assert wire.ask("status")["showing"] == "pattern"


def test_an_appearance_appears_byte_for_byte(wire: Wire, outputs: Outputs, folder: Path) -> None:
    shown = Frames(folder / "out.frame")
    for seed in (3, 0, 5, 3):
        assert wire.ask("play", appearance=str(seed))["ok"]
        assert same(shown.read(), noise(outputs, seed))
    assert wire.ask("status")["appearance"] == "3"
    assert wire.ask("stop")["ok"]
    assert dark(shown.read())


def test_pictures_come_on_the_grid_of_the_rate(start: Start, tmp_path: Path) -> None:
    with Wire(start(rate_hz=10.0).socket) as wire:
        moments = np.array([wire.ask("stop")["presented_at"] for _ in range(5)])
    phase = (moments * 10) % 1
    assert np.median(np.minimum(phase, 1 - phase)) < 0.2


def test_swaps_never_mix_two_appearances(wire: Wire, outputs: Outputs, folder: Path) -> None:
    shown = Frames(folder / "out.frame")
    expected = [noise(outputs, seed) for seed in range(6)]
    first = wire.ask("sequence", items=[[str(seed), 0.002] for seed in range(6)], rate_hz=500)
    seen = set()
    ends = time.monotonic() + 2
    while time.monotonic() < ends:
        now = shown.read()
        matches = [seed for seed in range(6) if same(now, expected[seed])]
        assert len(matches) == 1, "a set that is no appearance"
        seen |= set(matches)
    status = wire.ask("status")
    assert seen == set(range(6))
    assert status["sequence_running"]
    assert status["skipped"] == 0
    assert status["sequence"] - first["sequence"] > 200
    assert 0 < status["interval_p50_s"] <= status["interval_p99_s"]


def test_a_sequence_ends_with_its_last_item_after_its_repeats(wire: Wire, outputs: Outputs, folder: Path) -> None:
    first = wire.ask("sequence", items=[["1", 0.02], ["2", 0.05], ["1", 0.02], ["4", 0.02]], repeat=2)
    ends = time.monotonic() + 10
    while wire.ask("status")["sequence_running"] and time.monotonic() < ends:
        time.sleep(0.02)
    status = wire.ask("status")
    assert status["sequence"] - first["sequence"] == 7
    assert status["presented_at"] - first["presented_at"] > 0.15
    assert same(Frames(folder / "out.frame").read(), noise(outputs, 4))


def test_what_is_not_yet_presented_is_superseded_and_said_so(start: Start, bundle: Path) -> None:
    with Wire(start(bundle=bundle, allow_unsigned=True, rate_hz=2.0).socket) as wire:
        wire.ask("stop")
        wire.send(b'{"id": 1, "op": "play", "appearance": "1"}\n{"id": 2, "op": "play", "appearance": "2"}\n')
        answers = {answer["id"]: answer for answer in (wire.receive(), wire.receive())}
    assert answers[1]["error"]["code"] == "superseded"
    assert answers[2]["ok"] is True


MALFORMED = [
    b"\xff\xfe",
    b"{",
    b"[]",
    b"null",
    b"5",
    b"{}",
    b'{"op": 7}',
    b'{"op": ["play"]}',
    b'{"op": "dance"}',
    b'{"op": "show"}',
    b'{"op": "show", "sequence": -2}',
    b'{"op": "show", "sequence": 1e999}',
    b'{"op": "show", "sequence": true}',
    b'{"op": "show", "sequence": 2, "more": 1}',
    b'{"op": "play", "appearance": 5}',
    b'{"op": "play", "appearance": "\\u0000"}',
    b'{"op": "sequence", "items": []}',
    b'{"op": "sequence", "items": [["1"]]}',
    b'{"op": "sequence", "items": [["1", 0]]}',
    b'{"op": "sequence", "items": [["1", NaN]]}',
    b'{"op": "sequence", "items": [["1", 1]], "rate_hz": 0}',
    b'{"op": "sequence", "items": [["1", 1]], "repeat": -1}',
    b'{"op": "load-bundle"}',
    b'{"op": "hello", "self": 1}',
    b'{"id": {}, "op": "hello"}',
    b"[" * 100_000,
    b'{"op": "show", "sequence": ' + b"9" * 9000 + b"}",
]


def test_malformed_requests_are_answered_and_hurt_nobody(wire: Wire) -> None:
    for line in MALFORMED:
        wire.send(line + b"\n")
        answer = wire.receive()
        assert answer["ok"] is False
        assert answer["error"]["code"] == "request-wrong"
        assert answer["error"]["what"].endswith(".")
        assert answer["error"]["remedy"].endswith(".")
    assert wire.ask("hello")["ok"]


@pytest.mark.parametrize(
    ("operation", "values", "code"),
    [
        ("show", {"sequence": 2**40}, "inbox-sequence"),
        ("play", {"appearance": "none of them"}, "bundle-no-appearance"),
        ("sequence", {"items": [["1", 1], ["9", 1]]}, "bundle-no-appearance"),
        ("load-bundle", {"path": "/nowhere/b.vel"}, "bundle-unreadable"),
        ("load-bundle", {"path": "/dev/null"}, "bundle-unreadable"),
        ("load-bundle", {"path": "/proc/self/environ"}, "bundle-damaged"),
    ],
)
def test_what_can_not_be_done_is_refused_and_the_picture_stays(
    wire: Wire, outputs: Outputs, folder: Path, operation: str, values: dict[str, object], code: str
) -> None:
    wire.ask("play", appearance="1")
    assert wire.ask(operation, **values)["error"]["code"] == code
    assert same(Frames(folder / "out.frame").read(), noise(outputs, 1))


def test_frames_that_are_still_being_written_are_not_shown(wire: Wire, outputs: Outputs, folder: Path) -> None:
    inbox = Frames(Path(wire.ask("hello")["inbox"]))
    sequence = inbox.write(noise(outputs, 50))
    inbox._words[2] += 1
    assert wire.ask("show", sequence=sequence)["error"]["code"] == "frames-changing"
    inbox.write(noise(outputs, 50))
    assert dark(Frames(folder / "out.frame").read())


def test_an_endless_line_ends_its_connection_and_no_other(wire: Wire, folder: Path) -> None:
    with Wire(folder / "player.sock") as talker:
        talker.send(b"x" * 300_000)
        assert talker.receive()["error"]["code"] == "request-wrong"
        assert talker.ended()
        talker.send(b"x" * 300_000)
    assert wire.ask("hello")["ok"]


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
    ends = time.monotonic() + 10
    while player.alive and time.monotonic() < ends:
        time.sleep(0.01)
    return player.terminate()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_leaves_black_and_no_socket(start: Start, bundle: Path, tmp_path: Path, number: int) -> None:
    player = start(bundle=bundle, allow_unsigned=True)
    with Wire(player.socket) as wire:
        wire.ask("sequence", items=[["1", 0.05], ["2", 0.05]])
        os.kill(player.pid, number)
    assert exit_code(player) == 0
    assert dark(Frames(tmp_path / "out.frame").read())
    assert not player.socket.exists()
    assert player.log.read_text() == ""


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
        (["--outputs", "P1:8x8,P1:8x8", "--frames", "f"], 2, "one name"),
        (["--outputs", "P1", "--frames", "f"], 2, "NAME:WIDTHxHEIGHT"),
        (["--outputs", "P1:8x8", "--frames", "f", "--rate", "0"], 2, "rate"),
        (["--outputs", "P1:8x8", "--frames", "f", "--rate", "nan"], 2, "rate"),
        (["--outputs", "P1:8x8", "--frames", "f", "--trusted", "/nowhere"], 2, "key file"),
        (["--outputs", "P1:8x8", "--frames", "/proc/f"], 1, "could not be written"),
        (["--outputs", "P1:8x8", "--frames", "f", "--bundle", "/nowhere"], 1, "can not be read"),
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
    with pytest.raises(WorkError, match=r"/nowhere/b\.vel can not be read") as caught:
        start(bundle=Path("/nowhere/b.vel"))
    assert caught.value.code == "player-not-started"


def test_bundles_are_swapped_without_a_black_frame_and_only_if_ours(
    start: Start, outputs: Outputs, tmp_path: Path
) -> None:
    keys = [tmp_path / "ours", tmp_path / "theirs"]
    for path in keys:
        generate_key(path)
    made: dict[str, Any] = {"stage": "s", "calibration": "c", "created_unix_s": 0}
    small = [(name, 8, 8) for name, _, _ in outputs]
    for file, key, sizes in (("a", 0, outputs), ("b", 0, outputs), ("foreign", 1, outputs), ("small", 0, small)):
        appearance = NewAppearance("x", noise(sizes, ord(file[0])))
        signer = load_signing_key(keys[key])
        write_bundle(tmp_path / file, **made, outputs=sizes, appearances=[appearance], key=signer)
    shown = start(bundle=tmp_path / "a", trusted=[tmp_path / "ours.pub"])
    frames = Frames(tmp_path / "out.frame")
    with Wire(shown.socket) as wire:
        wire.ask("play", appearance="x")
        swaps = frames.sequence
        for file, code in (("foreign", "bundle-untrusted"), ("small", "bundle-outputs-differ")):
            assert wire.ask("load-bundle", path=str(tmp_path / file))["error"]["code"] == code
        before = wire.ask("hello")["bundle"]
        assert wire.ask("load-bundle", path=str(tmp_path / "b"))["bundle"] != before
        assert frames.sequence == swaps
        assert same(frames.read(), noise(outputs, ord("a")))
        wire.ask("play", appearance="x")
        assert frames.sequence == swaps + 2
        assert same(frames.read(), noise(outputs, ord("b")))


def test_a_damaged_appearance_is_skipped_and_the_others_play_on(
    start: Start, bundle: Path, outputs: Outputs, tmp_path: Path
) -> None:
    data = bytearray(bundle.read_bytes())
    data[4096 + 20] ^= 1  # in the first stripe of "0"
    bundle.write_bytes(data)
    with Wire(start(bundle=bundle, allow_unsigned=True).socket) as wire:
        wire.ask("play", appearance="1")
        assert wire.ask("play", appearance="0")["error"]["code"] == "bundle-damaged"
        assert same(Frames(tmp_path / "out.frame").read(), noise(outputs, 1))
        first = wire.ask("sequence", items=[["2", 0.02], ["0", 0.02], ["3", 0.02]], repeat=3)
        ends = time.monotonic() + 10
        while (status := wire.ask("status"))["sequence_running"] and time.monotonic() < ends:
            time.sleep(0.02)
        assert status["sequence"] - first["sequence"] == 5
        assert status["skipped"] == 4


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


def test_memory_stays_bounded_over_many_swaps(wire: Wire) -> None:
    items = [[str(seed), 0.001] for seed in range(6)]
    wire.ask("sequence", items=items, rate_hz=1000)
    time.sleep(0.5)
    before = wire.ask("status")
    time.sleep(1.0)
    after = wire.ask("status")
    assert after["swaps"] - before["swaps"] > 100
    assert after["rss_bytes"] - before["rss_bytes"] < 2 * 2**20


def test_starting_loads_neither_the_window_library_nor_the_rest_of_the_controller() -> None:
    program = "import sys, controller.play.__main__; print(*sys.modules)"
    modules = set(
        subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split()
    )
    heavy = {
        "pyglet",
        "scipy",
        "numba",
        "cv2",
        "pydantic",
        "typer",
        "rich",
        "controller.app",
        "controller.config",
        "hal",
    }
    assert not heavy & modules
