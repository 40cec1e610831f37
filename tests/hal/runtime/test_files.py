"""Reading files that somebody else wrote: other kinds of files are refused at once, huge pictures before decoding."""

from __future__ import annotations

import os
import socket
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from hal.runtime.files import (
    MOST_PIXELS,
    UnfitFile,
    picture_size,
    read_bytes,
    read_picture_bytes,
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


@pytest.mark.parametrize("ending", ["png", "jpg", "tif", "bmp", "ppm", "pgm"])
@pytest.mark.parametrize("size", [(1, 1), (37, 5), (640, 481)])
def test_the_size_in_the_header_is_the_one_that_is_decoded(ending: str, size: tuple[int, int]) -> None:
    picture = np.zeros((size[1], size[0], 3), np.uint8)
    data = bytes(cv2.imencode(f".{ending}", picture[..., 0] if ending == "pgm" else picture)[1])
    assert picture_size(data) == size


@pytest.mark.parametrize(
    "options", [{"progressive": True}, {"exif": b"Exif\0\0" + bytes(500)}, {"comment": b"x" * 900}]
)
def test_the_size_of_a_jpeg_is_found_behind_its_other_parts(tmp_path: Path, options: dict[str, Any]) -> None:
    Image.new("RGB", (321, 123)).save(tmp_path / "x.jpg", **options)
    assert picture_size((tmp_path / "x.jpg").read_bytes()) == (321, 123)


@pytest.mark.parametrize(
    "data", [b"", b"\x89PNG\r\n\x1a\n", b"\xff\xd8", b"\xff\xd8\xff", b"II*\0", b"MM\0*\xff\xff\xff\xff", b"P6"]
)
def test_a_header_that_is_cut_off_has_no_size(data: bytes) -> None:
    assert picture_size(data) is None


def test_a_picture_of_too_many_pixels_is_refused_before_it_is_decoded(tmp_path: Path) -> None:
    path = tmp_path / "x.png"
    side = int(MOST_PIXELS**0.5) + 1
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(8) + struct.pack(">II", side, side))
    with pytest.raises(UnfitFile, match=f"{side} x {side} pixels"):
        read_picture_bytes(path)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(8) + struct.pack(">II", side, 10))
    assert read_picture_bytes(path)
