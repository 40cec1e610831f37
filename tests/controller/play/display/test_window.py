"""Real windows on an X server: what the server's framebuffer holds is what was asked for, byte for byte.

Needs Xvfb (package xvfb) and software OpenGL (libgl1-mesa-dri); a machine without them fails here.
"""

from __future__ import annotations

import os
import signal
import struct
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from controller.kiosk.decide.interfaces import Showing
from controller.kiosk.supervisors.player_supervisor import PlayerSupervisor
from controller.play.control.launch import PlayerProcess, PlayerSettings
from hal.notices import Notice
from tests.controller.play.wire import Frames, Pictures, Wire, noise
from tests.waiting import meanwhile, wait_for

Outputs = list[tuple[str, int, int]]
Start = Callable[..., PlayerProcess]
WIDTH, HEIGHT = 120, 31


class Framebuffer:
    """Xvfb's memory, which it keeps in a file in X Window Dump format (XWDFile.h)."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def picture(self) -> npt.NDArray[np.uint8]:
        """The screen, (rows, columns, 3) RGB."""
        data = self._path.read_bytes()
        head = struct.unpack(">25I", data[:100])
        start = head[0] + 12 * head[19]
        rows, columns, order, bits, stride = head[5], head[4], head[7], head[11], head[12]
        assert (order, bits) == (0, 32), "least significant byte first, four bytes a pixel"
        lines = np.frombuffer(data, np.uint8, rows * stride, start).reshape(rows, stride)
        return lines[:, : 4 * columns].reshape(rows, columns, 4)[:, :, 2::-1]


@pytest.fixture(scope="module")
def framebuffer(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Framebuffer]:
    folder = tmp_path_factory.mktemp("x")
    reading, writing = os.pipe()
    command = ["Xvfb", "-displayfd", str(writing), "-screen", "0", f"{WIDTH}x{HEIGHT}x24", "-fbdir", str(folder)]
    with (folder / "log").open("wb") as log:
        server = subprocess.Popen(
            [*command, "-nolisten", "tcp", "-nocursor", "-noreset"], pass_fds=[writing], stderr=log
        )
    try:
        os.close(writing)
        number = b""
        while not number.endswith(b"\n"):
            piece = os.read(reading, 16)
            assert piece, f"Xvfb did not start: {(folder / 'log').read_text()}"
            number += piece
        os.environ["DISPLAY"] = f":{number.decode().strip()}"
        yield Framebuffer(folder / "Xvfb_screen0")
    finally:
        os.environ.pop("DISPLAY", None)
        os.close(reading)
        server.terminate()
        server.wait()


def spanned(pictures: Pictures, outputs: Outputs) -> npt.NDArray[np.uint8]:
    """The outputs side by side on a black screen."""
    screen = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    left = 0
    for name, width, height in outputs:
        screen[:height, left : left + width] = pictures[name]
        left += width
    return screen


def test_patterns_and_appearances_reach_the_screen_byte_for_byte(
    framebuffer: Framebuffer, start: Start, bundle: Path, outputs: Outputs
) -> None:
    assert sum(width for _, width, _ in outputs) == WIDTH
    player = start(frames=None, bundle=bundle, allow_unsigned=True)
    with Wire(player.socket) as wire:
        inbox = Frames(Path(wire.ask("hello")["inbox"]))
        for seed in range(4):
            assert wire.ask("play", appearance=str(seed))["ok"]
            np.testing.assert_array_equal(framebuffer.picture(), spanned(noise(outputs, seed), outputs))
            pattern = noise(outputs, 100 + seed)
            assert wire.ask("show", sequence=inbox.write(pattern))["ok"]
            np.testing.assert_array_equal(framebuffer.picture(), spanned(pattern, outputs))
        assert wire.ask("stop")["ok"]
        assert not framebuffer.picture().any()


def test_a_window_that_was_covered_is_repaired(
    framebuffer: Framebuffer, start: Start, bundle: Path, outputs: Outputs
) -> None:
    player = start(frames=None, bundle=bundle, allow_unsigned=True)
    expected = spanned(noise(outputs, 2), outputs)
    with Wire(player.socket) as wire:
        wire.ask("play", appearance="2")
        cover_screen()
        ends = time.monotonic() + 60
        while not np.array_equal(framebuffer.picture(), expected) and time.monotonic() < ends:
            time.sleep(0.02)
        np.testing.assert_array_equal(framebuffer.picture(), expected)
        assert wire.ask("status")["swaps"] == 2


def cover_screen() -> None:
    """Another program maps a window over everything, paints it, and goes away."""
    from pyglet.libs.x11 import xlib

    display = xlib.XOpenDisplay(None)
    window = xlib.XCreateSimpleWindow(display, xlib.XDefaultRootWindow(display), 0, 0, WIDTH, HEIGHT, 0, 0, 0xFFFFFF)
    xlib.XMapRaised(display, window)
    xlib.XSync(display, 0)
    xlib.XCloseDisplay(display)


def test_the_screen_is_black_when_the_player_has_ended_and_sequences_run(
    framebuffer: Framebuffer, start: Start, bundle: Path
) -> None:
    player = start(frames=None, bundle=bundle, allow_unsigned=True)
    with Wire(player.socket) as wire:
        first = wire.ask("sequence", items=[[str(seed), 1 / 60] for seed in range(6)], repeat=5)
        ends = time.monotonic() + 60
        while (status := wire.ask("status"))["sequence_running"] and time.monotonic() < ends:
            time.sleep(0.02)
        assert status["sequence"] - first["sequence"] == 29
    assert player.terminate() == 0
    # The X server notices that a program has ended, and then removes its window: some time after the program's end.
    wait_for(lambda: not framebuffer.picture().any())
    assert "Traceback" not in player.log.read_text()


def test_a_player_that_is_started_again_goes_on_without_black(
    framebuffer: Framebuffer, start: Start, bundle: Path, outputs: Outputs
) -> None:
    first = start(frames=None, bundle=bundle, allow_unsigned=True, resume=True)
    expected = spanned(noise(outputs, 2), outputs)
    with Wire(first.socket) as wire:
        wire.ask("play", appearance="2", fade_s=0.5)
    seen = []
    with meanwhile(lambda: seen.append(np.array_equal(framebuffer.picture(), expected))):
        leave(first)
        second = start(frames=None, bundle=bundle, allow_unsigned=True, resume=True)
        with Wire(second.socket) as wire:
            wait_for(lambda: wire.ask("status")["showing"] == "appearance")
    assert len(seen) > 10
    assert all(seen)
    np.testing.assert_array_equal(framebuffer.picture(), expected)
    with Wire(second.socket) as wire:
        wire.ask("play", appearance="3")
        np.testing.assert_array_equal(framebuffer.picture(), spanned(noise(outputs, 3), outputs))
    assert second.terminate() == 0
    wait_for(lambda: not framebuffer.picture().any())


@pytest.mark.parametrize("kept", [True, False])
def test_a_pattern_is_not_shown_any_more_after_a_restart(
    framebuffer: Framebuffer, start: Start, bundle: Path, outputs: Outputs, kept: bool
) -> None:
    first = start(frames=None, bundle=bundle, allow_unsigned=True, resume=kept)
    with Wire(first.socket) as wire:
        inbox = Frames(Path(wire.ask("hello")["inbox"]))
        assert wire.ask("show", sequence=inbox.write(noise(outputs, 7)))["ok"]
    leave(first)
    assert framebuffer.picture().any()
    start(frames=None, bundle=bundle, allow_unsigned=True, resume=kept)
    wait_for(lambda: not framebuffer.picture().any())


def test_a_picture_that_can_not_be_read_any_more_gives_way_to_black(
    framebuffer: Framebuffer, start: Start, bundle: Path
) -> None:
    first = start(frames=None, bundle=bundle, allow_unsigned=True, resume=True)
    with Wire(first.socket) as wire:
        wire.ask("play", appearance="0")
    leave(first)
    data = bytearray(bundle.read_bytes())
    data[4096 + 20] ^= 1  # in the first stripe of "0"
    bundle.write_bytes(data)
    start(frames=None, bundle=bundle, allow_unsigned=True, resume=True)
    wait_for(lambda: not framebuffer.picture().any())


def leave(player: PlayerProcess) -> None:
    """End it as `systemctl restart` does."""
    os.kill(player.pid, signal.SIGUSR1)
    wait_for(lambda: not player.alive)


def test_without_a_display_it_says_so(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", ":987")
    with pytest.raises(Exception, match="found no display"):
        start(frames=None)


def test_a_second_player_on_the_same_server_is_refused_and_may_come_when_the_first_is_gone(
    framebuffer: Framebuffer, start: Start, bundle: Path, outputs: Outputs, tmp_path: Path
) -> None:
    second = tmp_path / "second"
    second.mkdir()
    told: list[Notice] = []
    settings = PlayerSettings(outputs, None, bundle=bundle, allow_unsigned=True)
    supervisor = PlayerSupervisor(second, lambda _: settings, told.append)
    supervisor.want = Showing(bundle, "3")
    first = start(frames=None, bundle=bundle, allow_unsigned=True)
    try:
        with Wire(first.socket) as wire:
            wire.ask("play", appearance="2")
            supervisor.step()
            problem = supervisor.view.problem
            assert problem is not None
            assert f"Another player (process {first.pid}) already shows its pictures on this X server" in problem.what
            np.testing.assert_array_equal(framebuffer.picture(), spanned(noise(outputs, 2), outputs))
            first.kill()

        def shown() -> bool:
            supervisor.step()
            return supervisor.view.problem is None and supervisor.view.shown == supervisor.want

        wait_for(shown)
        np.testing.assert_array_equal(framebuffer.picture(), spanned(noise(outputs, 3), outputs))
    finally:
        supervisor.close()
