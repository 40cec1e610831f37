"""Uploaded files are enemies: decoded elsewhere, within limits, and never given back as they came."""

from __future__ import annotations

import contextlib
import io
import random
import struct
import time
import zlib
from pathlib import Path

import pytest
from PIL import Image

from controller.core.errors import UsageError
from controller.kiosk.store.accounts import Accounts, Role
from controller.panel.answers import INCOMING, temporary
from controller.panel.app import make_panel
from controller.panel.context import PanelOptions
from controller.panel.uploads import Targets, UploadLimits, decode_picture
from tests.controller.panel.memory_kiosk import MemoryKiosk
from tests.controller.panel.served import QUICK_HASH, Served, csrf

SMALL = UploadLimits(most_bytes=1 << 20, most_pixels=1_000_000, memory_bytes=400 << 20, seconds=3)


def jpeg(**options: object) -> bytes:
    out = io.BytesIO()
    Image.radial_gradient("L").convert("RGB").save(out, "JPEG", **options)
    return out.getvalue()


def png_of(width: int, height: int, data: bytes) -> bytes:
    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def test_what_comes_back_is_our_own_png_without_what_was_hidden_in_the_file(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x010E] = "<script>alert(1)</script>"
    exif[0x0112] = 6
    file = tmp_path / "in"
    file.write_bytes(jpeg(comment=b"secret place", exif=exif, quality=90) + b"<?php system($_GET[0]); ?>")
    png = decode_picture(file, SMALL)
    assert png.startswith(b"\x89PNG")
    assert not [word for word in (b"secret", b"script", b"php", b"eXIf", b"tEXt") if word in png]
    with Image.open(io.BytesIO(png)) as again:
        assert (again.mode, again.size) == ("RGB", (256, 256))


HOSTILE = {
    "empty": b"",
    "text": b"not a picture",
    "html": b"<html><script>alert(1)</script>",
    "svg": b'<svg xmlns="http://www.w3.org/2000/svg" onload="alert(1)"/>',
    "cut": jpeg()[:400],
    "eps": b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 10\nshowpage",
    "gif": b"GIF89a" + bytes(40),
    "bad-checksum": png_of(4, 4, b"\x00\x01\x02"),
    "lying-size": png_of(900, 900, zlib.compress(bytes(10))),
}


@pytest.mark.parametrize("name", list(HOSTILE))
def test_what_is_no_picture_is_refused(tmp_path: Path, name: str) -> None:
    file = tmp_path / "in"
    file.write_bytes(HOSTILE[name])
    with pytest.raises(UsageError) as caught:
        decode_picture(file, SMALL)
    assert caught.value.code == "picture-refused"


def test_a_bomb_is_refused_before_it_is_unpacked(tmp_path: Path) -> None:
    file = tmp_path / "in"
    file.write_bytes(png_of(60_000, 60_000, zlib.compress(bytes(1 << 20))))
    began = time.monotonic()
    with pytest.raises(UsageError) as caught:
        decode_picture(file, SMALL)
    assert caught.value.code == "picture-too-large"
    assert time.monotonic() - began < 30


def test_memory_beyond_the_limit_ends_the_decoder_and_nothing_else(tmp_path: Path) -> None:
    file = tmp_path / "in"
    Image.new("RGB", (9000, 9000)).save(file, "PNG")
    with pytest.raises(UsageError) as caught:
        decode_picture(file, UploadLimits(most_pixels=1 << 40, memory_bytes=200 << 20, seconds=10))
    assert caught.value.code == "picture-refused"


def test_time_beyond_the_limit_ends_the_decoder(tmp_path: Path) -> None:
    file = tmp_path / "in"
    noise = random.Random(1).randbytes(3 * 5000 * 5000)
    Image.frombytes("RGB", (5000, 5000), noise).save(file, "PNG", compress_level=0)
    began = time.monotonic()
    with pytest.raises(UsageError):
        decode_picture(file, UploadLimits(most_pixels=1 << 40, memory_bytes=4 << 30, seconds=1))
    assert time.monotonic() - began < 30


def test_only_the_newest_targets_are_kept_and_no_path_leads_out(tmp_path: Path) -> None:
    file = tmp_path / "in"
    file.write_bytes(jpeg())
    targets = Targets(tmp_path / "targets", SMALL, most=2)
    keys = [targets.add(file) for _ in range(3)]
    assert len(list((tmp_path / "targets").iterdir())) == 2
    assert targets.path(keys[-1]).is_file()
    for key in ("../in", "", "a" * 24, "/etc/passwd", keys[-1] + "\n"):
        with pytest.raises(UsageError):
            targets.path(key)


def test_an_upload_over_the_limit_is_stopped_and_leaves_no_file(fresh: Served) -> None:
    token = fresh.token(Role.OPERATOR)
    folder = fresh.app.state.panel.options.folder

    def endless() -> object:
        for _ in range(80):
            yield bytes(1 << 20)

    with fresh.client() as client:
        assert client.post("/api/v1/targets", content=bytes(100 << 20), headers=token).status_code == 413
        with contextlib.suppress(OSError):  # the door may also be shut while we still talk
            assert client.post("/api/v1/targets", content=endless(), headers=token).status_code == 413  # type: ignore[arg-type]
        assert client.post("/api/v1/play", content=b"{" + bytes(3 << 20), headers=token).status_code == 413
    assert not list((folder / "incoming").glob("*"))


def test_a_form_upload_leaves_only_our_own_picture(fresh: Served) -> None:
    with fresh.entered("otto") as client:
        sent = {"csrf": csrf(client.get("/appearances/new").text)}
        files = {"file": ("../../<b>evil</b>.png", jpeg(comment=b"mine"), "text/html")}
        answer = client.post("/do/upload-target", data=sent, files=files)
        assert answer.headers["location"].startswith("/appearances/new/")
        seen = client.get("/see/targets/" + answer.headers["location"].rsplit("/", 1)[1])
        assert seen.headers["content-type"] == "image/png"
        assert b"mine" not in seen.content
        refused = client.post("/do/upload-target", data=sent, files={"file": ("a.png", b"x")})
        assert (refused.status_code, "could not be read as a picture" in refused.text) == (422, True)


def test_what_a_killed_service_left_of_an_upload_is_gone_with_the_next_start(tmp_path: Path) -> None:
    options = PanelOptions(tmp_path)
    left = temporary(tmp_path / INCOMING)
    make_panel(MemoryKiosk(tmp_path / "pictures"), Accounts(tmp_path / "accounts.json", hasher=QUICK_HASH), options)
    assert not left.exists()
