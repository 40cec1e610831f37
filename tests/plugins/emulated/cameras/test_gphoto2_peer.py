"""Debian's gphoto2 by other authors, as a client of the emulated camera: does it take it for a real one?"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest

from lab.emulated.cameras.camera import BODIES
from tests.campaigns.camera_peers import FLAVOURS, SIZE, Flavour, Peer, Way, network_peer, usb_peer


@pytest.fixture(params=["network", "usb"])
def way(request: pytest.FixtureRequest) -> Way:
    way: Way = {"network": network_peer, "usb": usb_peer}[request.param]
    return way


@pytest.fixture(params=FLAVOURS)
def flavour(request: pytest.FixtureRequest) -> Flavour:
    flavour: Flavour = request.param
    return flavour


@pytest.fixture
def peer(way: Way, flavour: Flavour) -> Iterator[Peer]:
    with way(flavour) as peer:
        yield peer


def test_the_summary_and_the_settings_tell_what_the_camera_is(peer: Peer, flavour: Flavour) -> None:
    said = peer.gphoto2("--summary", "--list-config")
    assert f"Model: {BODIES[flavour].usual_names.model}" in said
    assert f"Serial Number: {BODIES[flavour].usual_names.serial}" in said
    assert "Maximum Capability: 4294967296" in said
    # gphoto2 reads a Sony body's battery only as one of its own properties, 0xd218.
    assert ("/main/other/d218" if flavour == "sony" else "value: 90%") in said
    assert "Image Capture" in said or "Canon EOS Capture" in said
    for name in ("shutterspeed", "iso"):
        assert name in said


def test_a_shutter_speed_that_is_set_is_kept_and_a_capture_comes_byte_for_byte(peer: Peer, flavour: Flavour) -> None:
    wanted = "1/4" if flavour == "sony" else "0.5"  # as gphoto2 writes them for this maker
    said = peer.gphoto2(
        *("--set-config", f"shutterspeed={wanted}", "--capture-image-and-download", "--filename", "shot.jpg"),
        *("--get-config", "shutterspeed"),
    )
    assert f"Current: {wanted}" in said
    assert (peer.folder / "shot.jpg").read_bytes() == peer.picture(1)
    assert peer.exposures() == 1


def test_several_captures_in_a_row_are_all_downloaded() -> None:
    """Fifty of them: tests/campaigns/camera_peers.py. Ten cameras side by side, because gphoto2 mostly waits."""

    def three(camera: tuple[Way, Flavour]) -> int:
        way, flavour = camera
        with way(flavour) as peer:
            peer.captures(3)
            return peer.exposures()

    cameras = [(way, flavour) for way in (network_peer, usb_peer) for flavour in FLAVOURS]
    with ThreadPoolExecutor(len(cameras)) as side_by_side:
        assert list(side_by_side.map(three, cameras)) == [3] * len(cameras)


def test_a_raw_picture_is_fetched_from_the_card(way: Way) -> None:
    with way("eos-new") as peer:
        peer.gphoto2("--set-config", "imageformat=RAW", "--set-config", "capturetarget=1", "--capture-image")
        assert "IMG_0001.DNG" in peer.gphoto2("--list-files")
        peer.gphoto2("--get-all-files", "--filename", "raw.dng")
        assert (peer.folder / "raw.dng").read_bytes() == peer.picture(1, raw=True)
        assert len(peer.picture(1, raw=True)) > SIZE // 2
