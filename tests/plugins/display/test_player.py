"""The display driver on a real player with memory outputs."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from controller.bundle.writer import NewAppearance, NewBundle, write_bundle
from controller.play.control.launch import PlayerProcess, PlayerSettings, start_player
from hal.conformance import BundleDisplayConformance
from hal.deadline import Cancelled, in_seconds
from hal.errors import DeviceGone, DeviceRefused, DeviceTimeout, PluginError, ProtocolError
from hal.registry import OpenContext
from plugins.display.player import DRIVER, PlayerDisplay
from tests.controller.play.wire import Frames, noise

OUTPUTS = [("P1", 20, 15), ("P2", 21, 16)]
TABLES = [{"name": name, "width_px": width, "height_px": height} for name, width, height in OUTPUTS]


def written(bundle: Path) -> None:
    write_bundle(
        bundle,
        NewBundle(stage="s", calibration="c", created_unix_s=0, outputs=OUTPUTS),
        appearances=[NewAppearance(str(seed), noise(OUTPUTS, seed)) for seed in range(2)],
    )


@pytest.fixture
def player(tmp_path: Path) -> Iterator[PlayerProcess]:
    bundle = tmp_path / "b.vel"
    written(bundle)
    settings = PlayerSettings(OUTPUTS, tmp_path / "out.frame", bundle=bundle, allow_unsigned=True)
    with start_player(tmp_path, settings) as process:
        yield process


def opened(folder: Path, **settings: Any) -> PlayerDisplay:
    display = DRIVER.open({"outputs": TABLES, **settings}, OpenContext(folder, runtime=folder), in_seconds(20))
    assert isinstance(display, PlayerDisplay)
    return display


@pytest.fixture
def display(player: PlayerProcess, tmp_path: Path) -> Iterator[PlayerDisplay]:
    device = opened(tmp_path)
    yield device
    device.close()


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Where a player serves that no test ends, and a bundle for it."""
    path = tmp_path_factory.mktemp("player")
    written(path / "b.vel")
    with start_player(path, PlayerSettings(OUTPUTS, path / "out.frame", allow_unsigned=True)):
        yield path


class TestPlayerDisplay(BundleDisplayConformance):
    """The shared suite, every test on the same player."""

    @pytest.fixture
    def bundle(self, shared: Path) -> tuple[Path, tuple[str, str]]:
        return shared / "b.vel", ("0", "1")

    @pytest.fixture
    def display(self, shared: Path) -> Iterator[PlayerDisplay]:
        device = opened(shared)
        yield device
        device.close()


def shown(folder: Path) -> dict[str, npt.NDArray[np.uint8]]:
    return Frames(folder / "out.frame").read()


def test_frames_arrive_byte_for_byte_and_what_is_not_named_is_black(display: PlayerDisplay, tmp_path: Path) -> None:
    frames = noise(OUTPUTS, 9)
    presented = display.show(frames, deadline=in_seconds(20))
    assert all(np.array_equal(shown(tmp_path)[name], frames[name]) for name in frames)
    assert Frames(tmp_path / "out.frame").presented_at == presented.at_s
    display.show({"P2": frames["P2"][::-1, ::-1]}, deadline=in_seconds(20))
    assert not shown(tmp_path)["P1"].any()
    assert np.array_equal(shown(tmp_path)["P2"], frames["P2"][::-1, ::-1])


def test_appearances_sequences_status_and_bundles_through_the_driver(display: PlayerDisplay, tmp_path: Path) -> None:
    display.play("1", deadline=in_seconds(20))
    assert np.array_equal(shown(tmp_path)["P1"], noise(OUTPUTS, 1)["P1"])
    identity = display.load_bundle(tmp_path / "b.vel", deadline=in_seconds(20))
    assert display.status(deadline=in_seconds(20))["bundle"] == identity
    first = display.play_sequence([("0", 0.01), ("1", 0.01)], repeat=3, rate_hz=100, deadline=in_seconds(20))
    ends = time.monotonic() + 30
    while (status := display.status(deadline=in_seconds(20)))["sequence_running"] and time.monotonic() < ends:
        time.sleep(0.01)
    assert status["sequence"] == first.sequence + 5
    display.stop(deadline=in_seconds(20))
    assert not shown(tmp_path)["P1"].any()


def test_without_a_player_it_says_so_and_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(DeviceGone) as caught:
        opened(tmp_path)
    assert caught.value.code == "player-not-running"
    assert "velatura play" in caught.value.remedy


def test_a_player_of_another_stage_is_refused_with_both_lists(player: PlayerProcess, tmp_path: Path) -> None:
    with pytest.raises(DeviceRefused) as caught:
        opened(tmp_path, outputs=TABLES[:1])
    assert caught.value.code == "player-outputs-differ"
    assert "P2 21x16" in caught.value.what


@pytest.mark.parametrize("outputs", [[{"name": "P1"}], ["P1"], [{"name": "P1", "width_px": "x", "height_px": 2}]])
def test_wrong_settings_are_told_before_anything_is_opened(tmp_path: Path, outputs: Any) -> None:
    with pytest.raises(PluginError):
        opened(tmp_path, outputs=outputs)


def test_it_finds_a_restarted_player_again(display: PlayerDisplay, player: PlayerProcess, tmp_path: Path) -> None:
    display.show(noise(OUTPUTS, 1), deadline=in_seconds(20))
    os.kill(player.pid, signal.SIGKILL)
    player.restart()
    with pytest.raises(DeviceGone) as caught:
        display.show(noise(OUTPUTS, 2), deadline=in_seconds(20))
    assert caught.value.code == "player-gone"
    frames = noise(OUTPUTS, 3)
    display.show(frames, deadline=in_seconds(20))
    assert np.array_equal(shown(tmp_path)["P1"], frames["P1"])


def test_a_hung_player_costs_the_deadline_and_its_late_answer_is_not_mistaken(
    display: PlayerDisplay, player: PlayerProcess, tmp_path: Path
) -> None:
    os.kill(player.pid, signal.SIGSTOP)
    began = time.monotonic()
    with pytest.raises(DeviceTimeout):
        display.play("0", deadline=in_seconds(0.3))
    assert 0.25 < time.monotonic() - began < 10
    cancel = threading.Event()
    threading.Timer(0.1, cancel.set).start()
    with pytest.raises(Cancelled):
        display.status(deadline=in_seconds(30, cancel))
    os.kill(player.pid, signal.SIGCONT)
    assert display.status(deadline=in_seconds(20))["ok"]
    assert display.play("1", deadline=in_seconds(20)).sequence > 1
    assert np.array_equal(shown(tmp_path)["P1"], noise(OUTPUTS, 1)["P1"])


HELLO = b'{"id": 1, "ok": true, "player": "x", "protocol": 1, "pid": 1, "outputs": [], "inbox": "/dev/zero"}\n'


@pytest.mark.parametrize(
    ("answer", "error"),
    [
        (b"not json\n", ProtocolError),
        (b"[]\n", ProtocolError),
        (b"\xff\n", ProtocolError),
        (b"[" * 100_000 + b"\n", ProtocolError),
        (b"x" * 1_100_000, ProtocolError),
        (b'{"id": 1, "ok": true}\n', ProtocolError),
        (b'{"id": 1, "ok": false}\n', ProtocolError),
        (b'{"id": 1, "ok": false, "error": {"code": 5}}\n', ProtocolError),
        (HELLO.replace(b'"protocol": 1', b'"protocol": 2'), DeviceRefused),
        (HELLO.replace(b"[]", b"[5]"), ProtocolError),
        (HELLO, DeviceGone),
        (HELLO[:-20], DeviceGone),
    ],
)
def test_a_player_that_talks_nonsense_is_an_error_of_ours(
    tmp_path: Path, answer: bytes, error: type[Exception]
) -> None:
    with talking(tmp_path / "player.sock", answer), pytest.raises(error):
        DRIVER.open({}, OpenContext(tmp_path, runtime=tmp_path), in_seconds(30))


class talking:  # noqa: N801
    """A socket that answers the first request with these bytes and hangs up."""

    def __init__(self, path: Path, answer: bytes) -> None:
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._listener.bind(str(path))
        self._listener.listen()
        self._thread = threading.Thread(target=self._talk, args=(answer,))

    def _talk(self, answer: bytes) -> None:
        connection, _ = self._listener.accept()
        # The driver may have heard enough before the end.
        with connection, contextlib.suppress(OSError):
            connection.recv(9999)
            connection.sendall(answer)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._thread.join()
        self._listener.close()
