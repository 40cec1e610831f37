"""Reading files that somebody else wrote: other kinds of files are refused at once, huge pictures before decoding."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest

from hal.runtime.files import (
    UnfitFile,
    read_bytes,
    read_text,
    require_regular,
)


@pytest.mark.timeout(20)
@pytest.mark.parametrize("kind", ["pipe", "folder", "socket", "device"])
def test_what_is_no_regular_file_is_refused_without_waiting(
    tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "x"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        monkeypatch.chdir(tmp_path)
        with socket.socket(socket.AF_UNIX) as bound:
            bound.bind("x")
    with pytest.raises(OSError, match=r"."):
        read_bytes(path)
    with pytest.raises(UnfitFile):
        require_regular(path)


def test_size_and_byte_order_mark(tmp_path: Path) -> None:
    path = tmp_path / "x.toml"
    path.write_bytes(b"\xef\xbb\xbfa = 1\n")
    assert read_text(path) == "a = 1\n"
    assert read_bytes(path, 9) == path.read_bytes()
    with pytest.raises(UnfitFile, match="larger than 8 bytes"):
        read_bytes(path, 8)
    with pytest.raises(FileNotFoundError):
        read_bytes(tmp_path / "nothing")
    with pytest.raises(UnfitFile):
        read_bytes(Path("\0"))
