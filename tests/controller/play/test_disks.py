"""A player on a disk that became read-only: what plays continues, and what can not be kept is reported.

Root may write where the folder's mode says no, so the player is started without that right: as it is on a kiosk.
"""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import pytest

from controller.bundle.install import current, install
from controller.play.control.launch import PlayerProcess
from tests.controller.play.conftest import write_noise
from tests.controller.play.wire import Frames, Wire, noise, same

Outputs = list[tuple[str, int, int]]
Start = Callable[..., PlayerProcess]
Found = TypeVar("Found")
_PR_CAPBSET_DROP = 24
_RIGHTS = (1, 2, 3)
"""CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH, CAP_FOWNER (linux/capability.h)."""


def without_root_s_rights(start: Callable[[], Found]) -> Found:
    """What ``start`` returns; processes that it starts obey the modes of files, whatever user runs them."""

    def drop_and_start() -> Found:
        # Rights belong to the thread, which ends with this; a process that it starts has none that it has lost.
        for right in _RIGHTS if os.geteuid() == 0 else ():
            if ctypes.CDLL(None).prctl(_PR_CAPBSET_DROP, right, 0, 0, 0) != 0:
                pytest.skip("root may not give up its rights here, so no folder is read-only to it")
        return start()

    with ThreadPoolExecutor(1) as pool:
        return pool.submit(drop_and_start).result()


@contextmanager
def read_only(folder: Path) -> Iterator[None]:
    folder.chmod(0o500)
    try:
        yield
    finally:
        folder.chmod(0o700)


def test_a_disk_that_becomes_read_only_stops_no_picture(
    start: Start, bundle: Path, outputs: Outputs, tmp_path: Path
) -> None:
    player = without_root_s_rights(lambda: start(bundle=bundle, allow_unsigned=True, resume=True))
    shown = Frames(tmp_path / "out.frame")
    with Wire(player.socket) as wire:
        inbox = Frames(Path(wire.ask("hello")["inbox"]))
        assert wire.ask("play", appearance="1")["ok"]
        with read_only(tmp_path):
            for seed in (2, 3):
                assert wire.ask("play", appearance=str(seed))["ok"]
                assert same(shown.read(), noise(outputs, seed))
                assert wire.ask("show", sequence=inbox.write(noise(outputs, 60 + seed)))["ok"]
                assert same(shown.read(), noise(outputs, 60 + seed))
            assert "could not be saved" in player.log.read_text()
        assert wire.ask("play", appearance="4")["ok"]
    os.kill(player.pid, signal.SIGKILL)
    player.restart()
    ends = time.monotonic() + 60
    while not same(shown.read(), noise(outputs, 4)):
        assert time.monotonic() < ends, "what is played is kept again once the disk lets it"


def test_an_installed_bundle_plays_from_a_disk_that_is_read_only_from_the_start(
    start: Start, outputs: Outputs, tmp_path: Path
) -> None:
    folder = tmp_path / "bundles"
    install(write_noise(tmp_path / "b.vel"), folder, allow_unsigned=True)
    with read_only(folder):
        player = without_root_s_rights(lambda: start(bundle=folder / "current", allow_unsigned=True))
        with Wire(player.socket) as wire:
            assert wire.ask("play", appearance="1")["ok"]
            assert same(Frames(tmp_path / "out.frame").read(), noise(outputs, 1))
        assert player.terminate() == 0
    assert "count of starts could not be saved" in player.log.read_text()
    assert not (folder / "starts.json").exists()


def test_a_runtime_folder_that_is_read_only_is_told(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "controller.play", "--outputs", "P1:8x8"]
    command += ["--socket", str(tmp_path / "deep" / "s"), "--frames", str(tmp_path / "f")]
    (tmp_path / "deep").mkdir()
    with read_only(tmp_path / "deep"):
        ended = without_root_s_rights(
            lambda: subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
        )
    assert ended.returncode == 1
    assert "could not be" in ended.stderr
    assert len(ended.stderr.splitlines()) == 2


def test_an_installation_onto_a_disk_that_is_full_or_read_only_leaves_what_plays(tmp_path: Path) -> None:
    folder, source = tmp_path / "bundles", write_noise(tmp_path / "2.vel", revision=1)
    installed = install(write_noise(tmp_path / "1.vel"), folder, allow_unsigned=True)
    program = """
import sys; from pathlib import Path
from controller.bundle.install import install; from controller.core.errors import VelaturaError
try:
    install(Path(sys.argv[1]), Path(sys.argv[2]), allow_unsigned=True)
except VelaturaError as error:
    sys.exit(error.code)
"""
    command = [sys.executable, "-c", program, str(source), str(folder)]

    def told(words: list[str]) -> str:
        return subprocess.run(words, capture_output=True, text=True, timeout=20, check=False).stderr.strip()

    before = sorted(path.name for path in folder.iterdir())
    # The copy ends in the middle of the file, as on a disk that fills up.
    assert told(["prlimit", "--fsize=20000", *command]) == "no-space"
    assert sorted(path.name for path in folder.iterdir()) == before
    with read_only(folder):
        assert without_root_s_rights(lambda: told(command)) == "cannot-write"
    assert sorted(path.name for path in folder.iterdir()) == before
    assert current(folder) == installed
    assert told(command) == ""
    assert current(folder) != installed


def test_a_player_whose_socket_folder_is_no_folder_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    command = [sys.executable, "-m", "controller.play", "--outputs", "P1:8x8", "--frames", str(tmp_path / "f")]
    command += ["--socket", str(tmp_path / "file" / "s")]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
    assert ended.returncode == 1
    assert len(ended.stderr.splitlines()) == 2
    assert "could not be written" in ended.stderr
