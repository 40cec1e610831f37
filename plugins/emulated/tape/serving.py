"""Serves every device of a tape."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final

from hal.tape import Track
from plugins.emulated.cameras.camera import EmulatedPtpCamera
from plugins.emulated.tape.camera import TapeBody, no_files
from plugins.emulated.tape.lines import LineReplay, ReplayedPort, ReplayedTerminal

Served = Callable[[str, str, str], object]
"""Called with the device's name on the tape, the kind of its address, and the address."""
LINES: Final = ("serial", "tcp", "pjlink")


def serve_tape(
    tracks: Iterable[Track], folder: Path, stack: contextlib.ExitStack, served: Served, *, time_scale: float = 1.0
) -> int:
    """Start the devices of a tape until ``stack`` is closed; how many. ``folder``: for links to serial ports.

    All tracks of one kind and address are one device: each opening of it began another track. A device of an unknown
    kind is left out. ``time_scale``: of recorded delays.
    """
    count = 0
    for track in merged(tracks):
        if track.kind == "ptp":
            camera = stack.enter_context(EmulatedPtpCamera(no_files, body=TapeBody(track)))
            served(track.address, "camera", camera.address)
        elif track.kind == "serial":
            port = folder / (re.sub(r"[^A-Za-z0-9.-]+", "-", track.address) or "port")
            terminal = ReplayedTerminal(LineReplay(track), port, time_scale=time_scale)
            served(track.address, "serial", stack.enter_context(terminal).address)
        elif track.kind in LINES:
            line = stack.enter_context(ReplayedPort(LineReplay(track), time_scale=time_scale))
            served(track.address, track.kind, line.address)
        else:
            continue
        count += 1
    return count


def merged(tracks: Iterable[Track]) -> list[Track]:
    """One track for each device, in the order of their first ones."""
    devices: dict[tuple[str, str], Track] = {}
    for track in tracks:
        one = devices.setdefault((track.kind, track.address), Track(track.kind, track.address))
        one.entries.extend(track.entries)
    return list(devices.values())
