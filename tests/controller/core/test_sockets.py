"""A Unix socket takes connections from the moment at which it can be seen."""

from __future__ import annotations

import socket
import stat
import tempfile
import threading
from pathlib import Path

import pytest

from controller.core.storage import LONGEST_PATH_BYTES, listening


def test_whoever_sees_it_is_not_refused(tmp_path: Path) -> None:
    for number in range(200):
        path = tmp_path / f"{number}.sock"
        refused: list[OSError] = []
        watching = threading.Thread(target=connect_when_it_is_there, args=(path, refused))
        watching.start()
        with listening(path, 4):
            watching.join()
        assert refused == []


def connect_when_it_is_there(path: Path, refused: list[OSError]) -> None:
    while not path.exists():
        pass
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
        try:
            client.connect(str(path))
        except OSError as error:
            refused.append(error)


def test_it_is_for_this_user_alone_and_takes_the_place_of_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "s"
    for _ in range(2):
        with listening(path, 1):
            assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert [one.name for one in tmp_path.iterdir()] == ["s"]


def test_the_longest_path_is_taken_and_a_longer_one_leaves_nothing() -> None:
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:
        longest = Path(folder, "s" * (LONGEST_PATH_BYTES - len(folder) - 1))
        with listening(longest, 1):
            assert longest.is_socket()
        with pytest.raises(OSError, match="too long"):
            listening(Path(f"{longest}s"), 1)
        assert [one.name for one in Path(folder).iterdir()] == [longest.name]
