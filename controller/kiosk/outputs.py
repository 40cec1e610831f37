"""From what ``xrandr --verbose`` prints to the X server's configuration and the player's outputs."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

from controller.play.display.edid import serial_names

_OUTPUT: Final = re.compile(r"^(\S{1,64}) (connected|disconnected)(?: primary)?(?: (\d+)x(\d+)\+(\d+)\+(\d+))?\b")
_EDID: Final = re.compile(r"^\t\t([0-9a-f]{32})$")
_MODE: Final = re.compile(r"^ {2}(\S+) \(0x[0-9a-f]+\) +([\d.]+)MHz(.*)$")
_LINE: Final = re.compile(r"^ {8}([hv]): (?:width|height) +(\d+) start +(\d+) end +(\d+) total +(\d+)")
_FLAGS: Final = re.compile(r"[+-][HV]Sync|Interlace|DoubleScan", re.IGNORECASE)


@dataclass(slots=True)
class Mode:
    """``timing``: the numbers of a modeline; ``preferred``: the display asks for it; ``current``: it is shown."""

    clock_mhz: float
    flags: tuple[str, ...]
    preferred: bool
    current: bool
    timing: list[int] = field(default_factory=list)

    @property
    def key(self) -> tuple[int, int, float]:
        """Width, height and pictures a second."""
        width, across, height, down = self.timing[0], self.timing[3], self.timing[4], self.timing[7]
        return width, height, round(self.clock_mhz * 1e6 / max(1, across * down), 2)

    @property
    def name(self) -> str:
        return "{}x{}_{:.2f}".format(*self.key)

    @property
    def modeline(self) -> str:
        return " ".join([f'"{self.name}"', f"{self.clock_mhz:g}", *map(str, self.timing), *self.flags])


@dataclass(frozen=True, slots=True)
class Connected:
    """An output with something plugged into it, and what that can show.

    ``left_top_px``: where it is on the screen, None while it shows nothing; ``edid``: its display's description.
    """

    name: str
    modes: list[Mode]
    left_top_px: tuple[int, int] | None = None
    edid: bytes = b""

    @property
    def serials(self) -> tuple[str, ...]:
        """Names that tell its display from others."""
        return serial_names(self.edid)


@dataclass(frozen=True, slots=True)
class Placed:
    """An output with its mode, ``left_px`` from the screen's left edge."""

    name: str
    mode: Mode
    left_px: int


def connected(text: str) -> list[Connected]:
    """The connected outputs, in the X server's order."""
    outputs: list[Connected] = []
    modes: list[Mode] = []
    for line in text.splitlines():
        if found := _OUTPUT.match(line):
            modes = []
            if found[2] == "connected":
                place = None if found[5] is None else (int(found[5]), int(found[6]))
                outputs.append(Connected(found[1], modes, place))
            of_connected = found[2] == "connected"
        elif (found := _EDID.match(line)) and outputs and of_connected:
            outputs[-1] = replace(outputs[-1], edid=outputs[-1].edid + bytes.fromhex(found[1]))
        elif found := _MODE.match(line):
            flags = tuple(flag.lower() for flag in _FLAGS.findall(found[3]))
            modes.append(Mode(float(found[2]), flags, "+preferred" in found[3], "*current" in found[3]))
        elif (found := _LINE.match(line)) and modes:
            modes[-1].timing += [int(found[n]) for n in range(2, 6)]
    whole = [replace(one, modes=[mode for mode in one.modes if len(mode.timing) == 8]) for one in outputs]
    return [one for one in whole if one.modes]


def outputs_of_x() -> list[Connected]:
    """The X server's outputs as `xrandr` tells them; none without an X server."""
    # A library would end this process with the X server.
    try:
        done = subprocess.run(["xrandr", "--verbose"], capture_output=True, text=True, errors="replace", timeout=20)  # noqa: PLW1510, S607
    except (OSError, subprocess.TimeoutExpired):
        return []
    return connected(done.stdout) if done.returncode == 0 else []


def placed(outputs: Sequence[Connected], size_px: tuple[int, int] | None = None) -> list[Placed]:
    """Side by side, in one mode that all of them have: of ``size_px`` if there is one, then the one that most of them
    prefer, then the largest.

    Where no mode is common, each has the one that it prefers; the player then says what does not fit together.
    """
    common = set.intersection(*({mode.key for mode in one.modes} for one in outputs)) if outputs else set()
    preferred = [_preferred(one).key for one in outputs]
    best = max(
        common, key=lambda key: (key[:2] == size_px, preferred.count(key), key[0] * key[1], key[2]), default=None
    )
    found, left_px = [], 0
    for one in outputs:
        mode = next((mode for mode in one.modes if mode.key == best), _preferred(one))
        found.append(Placed(one.name, mode, left_px))
        left_px += mode.key[0]
    return found


def _preferred(output: Connected) -> Mode:
    preferred = [mode for mode in output.modes if mode.preferred] or [mode for mode in output.modes if mode.current]
    return (preferred or output.modes)[0]


def x_configuration(outputs: Sequence[Placed]) -> str:
    """A monitor section for each: the X server gives it to the output that has its name, also while nothing is lit."""
    head = "# Written by `velatura kiosk install`; `--outputs` writes it again, with what is plugged in then.\n"
    return head + "".join(
        f'Section "Monitor"\n'
        f'  Identifier "{one.name}"\n'
        f"  Modeline {one.mode.modeline}\n"
        f'  Option "PreferredMode" "{one.mode.name}"\n'
        f'  Option "Position" "{one.left_px} 0"\n'
        f'  Option "Enable" "true"\n'
        f'  Option "DPMS" "false"\n'
        f"EndSection\n"
        for one in outputs
    )


def player_outputs(outputs: Sequence[Placed]) -> list[tuple[str, int, int]]:
    """For ``PlayerSettings``."""
    return [(one.name, *one.mode.key[:2]) for one in outputs]
