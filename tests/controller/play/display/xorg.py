"""An X server with three outputs and no monitor: Xorg's dummy driver, set up by xrandr, its pixels read by mss."""

from __future__ import annotations

import ctypes
import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import mss
import numpy as np
import numpy.typing as npt

MODES = {
    "small": ["1.6", "160", "168", "176", "200", "120", "121", "123", "133"],
    "other": ["1.2", "120", "124", "128", "144", "100", "101", "103", "139"],
    "quick": ["3.2", "160", "168", "176", "200", "120", "121", "123", "133"],
    "paper": ["121.75", "1400", "1488", "1632", "1864", "1050", "1053", "1057", "1089"],
}
"""Modelines: 160x120 and 120x100 at 60 Hz, 160x120 at 120 Hz, 1400x1050 at 60 Hz."""
CONNECTORS = ("DUMMY0", "DUMMY1", "DUMMY2")
WIDTH, HEIGHT = 160, 120
_CONFIGURATION = """
Section "Device"
  Identifier "d"
  Driver "dummy"
  VideoRam 64000
EndSection
Section "Monitor"
  Identifier "m"
  HorizSync 1-1000
  VertRefresh 5-200
EndSection
Section "Screen"
  Identifier "s"
  Device "d"
  Monitor "m"
  DefaultDepth 24
EndSection
"""


class Outputs:
    """The outputs of a running server, as a technician sets them and as a camera sees them."""

    def __init__(self, display: str) -> None:
        self._display = display

    def xrandr(self, *words: str) -> None:
        subprocess.run(["xrandr", "-d", self._display, *words], check=True, capture_output=True)

    def place(self, connector: str, left: int, mode: str = "small") -> None:
        self.xrandr("--output", connector, "--mode", mode, "--pos", f"{left}x0")

    def reset(self) -> None:
        """All three side by side, nothing known of their displays, gamma plain."""
        for number, connector in enumerate(CONNECTORS):
            self.place(connector, number * WIDTH)
            self.xrandr("--output", connector, "--gamma", "1:1:1")
            self.set_edid(connector, b"")

    def picture(self, left: int, width: int = WIDTH, height: int = HEIGHT) -> npt.NDArray[np.uint8]:
        """What is shown from ``left`` on, (rows, columns, 3) RGB."""
        with mss.MSS(display=self._display) as camera:
            shot = camera.grab({"left": left, "top": 0, "width": width, "height": height})
        return np.frombuffer(shot.raw, np.uint8).reshape(height, width, 4)[:, :, 2::-1]

    def set_edid(self, connector: str, block: bytes) -> None:
        """Let the display at a connector report this."""
        from pyglet.libs.x11 import xlib, xrandr

        display = xlib.XOpenDisplay(self._display.encode())
        resources = xrandr.XRRGetScreenResourcesCurrent(display, xlib.XDefaultRootWindow(display))
        atom, integer = xlib.XInternAtom(display, b"EDID", 0), 19
        for output in resources.contents.outputs[: resources.contents.noutput]:
            info = xrandr.XRRGetOutputInfo(display, resources, output)
            if info.contents.name.decode() == connector:
                library: Any = xrandr.lib
                change = library.XRRChangeOutputProperty
                change.argtypes = [
                    ctypes.c_void_p,
                    *[ctypes.c_ulong] * 3,
                    *[ctypes.c_int] * 2,
                    ctypes.c_char_p,
                    ctypes.c_int,
                ]
                change(ctypes.cast(display, ctypes.c_void_p), output, atom, integer, 8, 0, block, len(block))
        xlib.XSync(display, 0)
        xlib.XCloseDisplay(display)


def edid(serial: str, number: int = 0) -> bytes:
    """A base block of the maker OTM with a serial number as text and as a number."""
    block = bytearray(128)
    block[:8] = bytes.fromhex("00ffffffffffff00")
    block[8:10] = (15 << 10 | 20 << 5 | 13).to_bytes(2, "big")
    block[12:16] = number.to_bytes(4, "little")
    block[72:90] = b"\0\0\0\xff\0" + serial.encode().ljust(13, b"\n")[:13]
    block[127] = -sum(block) % 256
    return bytes(block)


@contextmanager
def running_server(folder: Path, *, settings_folder: Path | None = None) -> Iterator[Outputs]:
    """Run a server on a free display number, which is ``DISPLAY`` meanwhile; also with all settings of a folder."""
    (folder / "xorg.conf").write_text(_CONFIGURATION)
    reading, writing = os.pipe()
    command = [
        "Xorg",
        "-displayfd",
        str(writing),
        "-config",
        str(folder / "xorg.conf"),
        "-logfile",
        str(folder / "log"),
    ]
    command += ["-noreset", "-nocursor", "-nolisten", "tcp", "-novtswitch", "-sharevts"]
    command += [] if settings_folder is None else ["-configdir", str(settings_folder)]
    with (folder / "told").open("wb") as told:
        server = subprocess.Popen(command, pass_fds=[writing], stdout=told, stderr=told)
    os.close(writing)
    before = os.environ.get("DISPLAY")
    try:
        number = b""
        while not number.endswith(b"\n"):
            piece = os.read(reading, 16)
            assert piece, f"Xorg did not start: {(folder / 'told').read_text()}"
            number += piece
        os.environ["DISPLAY"] = f":{number.decode().strip()}"
        outputs = Outputs(os.environ["DISPLAY"])
        for name, line in MODES.items():
            outputs.xrandr("--newmode", name, *line)
            for connector in CONNECTORS:
                outputs.xrandr("--addmode", connector, name)
        outputs.reset()
        yield outputs
    finally:
        os.environ.pop("DISPLAY", None)
        if before is not None:
            os.environ["DISPLAY"] = before
        os.close(reading)
        server.terminate()
        server.wait()
