"""Debian's gphoto2, which nobody here wrote, as a client of the emulated camera: does it take it for a real one?"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from plugins.emulated.ptp_camera import EmulatedPtpCamera, Flavour
from plugins.emulated.shot import ShotFiles, ShotSettings

FLAVOURS: tuple[Flavour, ...] = ("generic", "eos-new", "eos-old")
JPEG = b"\xff\xd8\xff\xe0\0\x10JFIF\0" + bytes(range(256)) * 700 + b"\xff\xd9"


class Peer:
    """An emulated camera and the gphoto2 that talks to it."""

    def __init__(self, emulator: EmulatedPtpCamera, shots: list[ShotSettings], folder: Path) -> None:
        self.emulator = emulator
        self.shots = shots
        self.folder = folder

    def gphoto2(self, *arguments: str) -> str:
        """Run gphoto2 with a configuration of its own; return all that it said, once it has succeeded."""
        program = shutil.which("gphoto2")
        assert program, "gphoto2 is not installed: run `make test`, whose set-up installs it (Debian package gphoto2)"
        done = subprocess.run(
            [program, "--port", self.emulator.address, *arguments],
            cwd=self.folder,
            env={"HOME": str(self.folder / "home"), "PATH": os.environ["PATH"], "LC_ALL": "C"},
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        assert "*** Error" not in done.stdout + done.stderr
        return done.stdout + done.stderr


@pytest.fixture(params=FLAVOURS)
def peer(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Peer]:
    shots: list[ShotSettings] = []

    def expose(settings: ShotSettings) -> ShotFiles:
        shots.append(settings)
        return ShotFiles(b"II*\0" + bytes(50_000) if settings.raw else None, JPEG if settings.jpeg else None)

    (tmp_path / "home").mkdir()
    with EmulatedPtpCamera(expose, flavour=request.param, time_scale=0.01) as emulator:
        yield Peer(emulator, shots, tmp_path)


def test_the_summary_names_the_camera_its_card_and_its_battery(peer: Peer) -> None:
    said = peer.gphoto2("--summary")
    assert f"Model: {peer.emulator.names.model}" in said
    assert "Maximum Capability: 4294967296" in said
    assert "value: 90%" in said
    assert "Image Capture" in said or "Canon EOS Capture" in said


def test_the_settings_can_be_listed(peer: Peer) -> None:
    said = peer.gphoto2("--list-config")
    for name in ("shutterspeed", "iso", "batterylevel"):
        assert name in said


def test_a_shutter_speed_that_is_set_is_the_one_of_the_next_exposure(peer: Peer) -> None:
    peer.gphoto2("--set-config", "shutterspeed=0.5", "--capture-image-and-download", "--filename", "shot.%C")
    assert peer.shots[-1].exposure_s == pytest.approx(0.5)
    assert "Current: 0.5" in peer.gphoto2("--get-config", "shutterspeed")


def test_a_capture_is_downloaded_byte_for_byte(peer: Peer) -> None:
    peer.gphoto2("--capture-image-and-download", "--filename", "shot.jpg")
    assert (peer.folder / "shot.jpg").read_bytes() == JPEG
    assert peer.emulator.exposures == 1


def test_several_captures_in_a_row_are_all_downloaded(peer: Peer) -> None:
    peer.gphoto2("--frames", "3", "--interval", "1", "--capture-image-and-download", "--filename", "%n.jpg")
    assert all((peer.folder / f"{number}.jpg").read_bytes() == JPEG for number in (1, 2, 3))
    assert peer.emulator.exposures == 3


def test_the_card_can_be_listed_and_a_raw_picture_fetched_from_it(tmp_path: Path) -> None:
    raw = b"II*\0" + bytes(1000)
    (tmp_path / "home").mkdir()
    with EmulatedPtpCamera(lambda _: ShotFiles(raw, None), flavour="eos-new", time_scale=0.01) as emulator:
        peer = Peer(emulator, [], tmp_path)
        peer.gphoto2("--set-config", "capturetarget=1", "--capture-image")
        assert "IMG_0001.DNG" in peer.gphoto2("--list-files")
        peer.gphoto2("--get-all-files", "--filename", "raw.dng")
        assert (tmp_path / "raw.dng").read_bytes() == raw
