"""Debian's gphoto2 against the emulated camera, over PTP/IP and over emulated USB, fifty captures in a row.

    python -m tests.campaigns.camera_peers [CAPTURES]

Prints one line for each of six cameras, and ends with 0 where each picture came byte for byte, and none twice. Then our
driver `gphoto2` does the same over PTP/IP, twenty captures of each; its overhead is what the process round the library
adds to a capture.
"""

from __future__ import annotations

import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from hal.deadline import in_seconds
from hal.errors import DeviceError
from hal.registry import OpenContext
from hal.values import ExposureSettings
from lab.emulated.cameras.camera import EmulatedPtpCamera, Flavour
from lab.emulated.usb.bus import environment
from lab.emulated.usb.camera import numbered_files
from lab.emulated.usb.process import UsbBusProcess
from plugins.emulated.core.shot import ShotFiles, ShotSettings
from plugins.gphoto2.camera import open_camera

__all__ = ["FLAVOURS", "SIZE", "Flavour", "Peer", "Way", "network_peer", "usb_peer"]

FLAVOURS: tuple[Flavour, ...] = ("generic", "eos-new", "eos-old", "nikon", "sony")
SIZE: Final = 150_000
_TIME_SCALE: Final = 0.01
_PATIENCE_S: Final = 60.0
_DRIVER_CAPTURES: Final = 20
_MOST_OVERHEAD_S: Final = 0.010


@dataclass
class Peer:
    """An emulated camera and the gphoto2 that talks to it."""

    port: str
    folder: Path
    exposures: Callable[[], int]
    surroundings: dict[str, str]

    def gphoto2(self, *arguments: str, patience_s: float = _PATIENCE_S) -> str:
        """Run gphoto2 with a configuration of its own; return what it said. Raises AssertionError where it fails."""
        program = shutil.which("gphoto2")
        assert program, "gphoto2 is not installed: run `make test`, whose set-up installs it (Debian package gphoto2)"
        done = subprocess.run(
            [program, "--port", self.port, *arguments],
            cwd=self.folder,
            env={"HOME": str(self.folder / "home"), "PATH": os.environ["PATH"], "LC_ALL": "C", **self.surroundings},
            capture_output=True,
            text=True,
            timeout=patience_s,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        assert "*** Error" not in done.stdout + done.stderr, done.stdout + done.stderr
        return done.stdout + done.stderr

    def picture(self, number: int, *, raw: bool = False) -> bytes:
        """The bytes of the ``number``-th exposure."""
        files = numbered_files(number, SIZE, ShotSettings(1, 100, 8, raw=raw, jpeg=not raw))
        return (files.raw if raw else files.jpeg) or b""

    def captures(self, count: int) -> None:
        """So many in a row, each the right one."""
        every = ("--frames", str(count), "--interval", "1")
        self.gphoto2(*every, "--capture-image-and-download", "--filename", "%n.jpg", patience_s=_PATIENCE_S + 4 * count)
        for number in range(1, count + 1):
            assert (self.folder / f"{number}.jpg").read_bytes() == self.picture(number), number


Way = Callable[[Flavour], AbstractContextManager[Peer]]


@contextmanager
def network_peer(flavour: Flavour) -> Iterator[Peer]:
    """The camera on PTP/IP."""
    made: list[EmulatedPtpCamera] = []

    def expose(shot: ShotSettings) -> ShotFiles:
        return numbered_files(made[0].body.exposures, SIZE, shot)

    made.append(EmulatedPtpCamera(expose, flavour=flavour, time_scale=_TIME_SCALE))
    with _folder() as folder, made[0] as camera:
        yield Peer(camera.address, folder, lambda: camera.body.exposures, {})


@contextmanager
def usb_peer(flavour: Flavour) -> Iterator[Peer]:
    """The camera on the emulated USB bus, which gphoto2's own libusb finds."""
    with _folder() as folder, _folder() as bus_folder, UsbBusProcess(bus_folder) as bus:
        bus.add("camera", "camera", flavour=flavour, size=SIZE, time_scale=_TIME_SCALE)
        yield Peer("usb:", folder, lambda: int(bus.get("camera", "body.exposures")), environment(bus_folder))


@contextmanager
def _folder() -> Iterator[Path]:
    # A unix socket's path is short, and pytest's own folders are not.
    with tempfile.TemporaryDirectory(prefix="peer", dir="/tmp") as name:
        (Path(name) / "home").mkdir()
        yield Path(name)


def _campaign(way: Way, flavour: Flavour, count: int) -> str:
    with way(flavour) as peer:
        try:
            peer.captures(count)
        except (AssertionError, subprocess.TimeoutExpired) as error:
            return f"FAILED: {error}"
        return "holds" if peer.exposures() == count else f"EXPOSED {peer.exposures()} TIMES"


def driver_captures(flavour: Flavour, count: int) -> float:
    """Captures with our driver on libgphoto2, each the right one; the median overhead of its process in seconds."""
    with network_peer(flavour) as peer:
        settings = {"address": peer.port}
        camera = open_camera(settings, OpenContext(peer.folder), in_seconds(_PATIENCE_S))
        overheads = []
        try:
            assert camera.capabilities.jpeg, "the body says that it makes JPEG files"
            camera.configure(ExposureSettings(0.5, 200, None, raw=False), deadline=in_seconds(_PATIENCE_S))
            for number in range(1, count + 1):
                began_s = time.monotonic()
                files = camera.capture(peer.folder / str(number), deadline=in_seconds(_PATIENCE_S))
                overheads.append(time.monotonic() - began_s - camera.process.took_s)
                assert [file.path.read_bytes() for file in files] == [peer.picture(number)], number
        finally:
            camera.close()
        assert peer.exposures() == count, f"exposed {peer.exposures()} times"
        return statistics.median(overheads)


def _driver_campaign(flavour: Flavour) -> bool:
    try:
        overhead_s = driver_captures(flavour, _DRIVER_CAPTURES)
    except (AssertionError, DeviceError) as error:
        print(f"driver   {flavour:<8} FAILED: {error}")
        return False
    print(f"driver   {flavour:<8} {_DRIVER_CAPTURES} captures: holds, overhead {1000 * overhead_s:.1f} ms", flush=True)
    return overhead_s <= _MOST_OVERHEAD_S


def main() -> int:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 50
    started = time.monotonic()
    ways: dict[str, Way] = {"network": network_peer, "usb": usb_peer}
    with ThreadPoolExecutor(len(ways) * len(FLAVOURS)) as side_by_side:
        found = {
            (name, flavour): side_by_side.submit(_campaign, way, flavour, count)
            for name, way in ways.items()
            for flavour in FLAVOURS
        }
        for (name, flavour), word in found.items():
            print(f"{name:<8} {flavour:<8} {count} captures: {word.result()}", flush=True)
    driven = [_driver_campaign(flavour) for flavour in FLAVOURS]
    print(f"{time.monotonic() - started:.0f} s")
    return 0 if all(driven) and all(word.result() == "holds" for word in found.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
