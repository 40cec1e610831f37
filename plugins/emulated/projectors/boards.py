"""The emulated control boards by the shipped profiles that speak to them, and a projector of bench.toml on its wire."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Mapping
from importlib import resources
from pathlib import Path
from typing import Any, Final, TypeAlias

from hal.errors import DeviceError, PluginError
from plugins.emulated.core.truth import FILE_NAME, ProjectorTruth
from plugins.emulated.projectors.board import Board
from plugins.emulated.projectors.boards_binary import (
    Ep910Board,
    HitachiBoard,
    JvcBoard,
    NecBoard,
    SdcpBoard,
    ViewSonicBoard,
)
from plugins.emulated.projectors.boards_marked import BarcoPulseBoard, ChristieBoard, PanasonicBoard, PanasonicDzBoard
from plugins.emulated.projectors.boards_text import (
    AcerBoard,
    AdcpBoard,
    BenqBoard,
    DigitalProjectionBoard,
    DigitalProjectionVBoard,
    EpsonBoard,
    OptomaBoard,
    SanyoBoard,
)
from plugins.emulated.projectors.lamp import EmulatedLamp, LampTiming
from plugins.emulated.projectors.network import GATES, EmulatedNetworkProjector
from plugins.emulated.projectors.serial import EmulatedSerialProjector

DEFAULT_BOARD: Final = "optoma-later"
BOARDS: Final[Mapping[str, Callable[[EmulatedLamp], Board]]] = {
    DEFAULT_BOARD: OptomaBoard,
    "epson-escvp21": EpsonBoard,
    "benq": BenqBoard,
    "christie": ChristieBoard,
    "nec": NecBoard,
    "optoma-ep910": Ep910Board,
    "panasonic": PanasonicBoard,
    "sanyo": SanyoBoard,
    "panasonic-dz": PanasonicDzBoard,
    "sony-adcp": AdcpBoard,
    "sony-sdcp": SdcpBoard,
    "jvc": JvcBoard,
    "barco-pulse": BarcoPulseBoard,
    "digital-projection": DigitalProjectionBoard,
    "digital-projection-v": DigitalProjectionVBoard,
    "hitachi": HitachiBoard,
    "acer": AcerBoard,
    "viewsonic": ViewSonicBoard,
}


def board_named(family: str) -> Callable[[EmulatedLamp], Board]:
    """Makes the board of a family. Raises DeviceError("board-unknown")."""
    if family not in BOARDS:
        raise DeviceError(
            "board-unknown",
            what=f"There is no emulated board for {family}.",
            remedy=f"Choose one of {', '.join(BOARDS)}, or add it to plugins/emulated/projectors/boards.py.",
        )
    return BOARDS[family]


def baud_of(family: str) -> int:
    """The usual baud rate of a family, from its shipped profile; 0 for one that has only a network port."""
    return int(_table(family, "serial").get("baud", 0))


def login_of(family: str) -> str:
    """What the network port of a family wants first (a key of ``GATES``); "" for one without such a port."""
    network = _table(family, "network")
    return str(network.get("login", "none")) if network else ""


def _table(family: str, name: str) -> dict[str, Any]:
    text = (resources.files("firmware_configs") / "projectors" / f"{family}.toml").read_text(encoding="utf-8")
    table = tomllib.loads(text).get(name, {})
    return table if isinstance(table, dict) else {}


Wire: TypeAlias = EmulatedSerialProjector | EmulatedNetworkProjector


def projector_on_its_wire(stage: Path, truth: ProjectorTruth, lamp: EmulatedLamp, boot_s: float) -> Wire:
    """The projector, not started yet. Raises DeviceError("board-unknown") or DeviceError("board-without-wire")."""
    board = board_named(truth.board)(lamp)
    if not truth.tcp_port:
        if not baud_of(truth.board):
            raise _no_wire(f"{truth.board} has no serial line", "Set tcp_port of this projector")
        return EmulatedSerialProjector(stage / truth.port, lamp, baud=baud_of(truth.board), board=board, boot_s=boot_s)
    login = login_of(truth.board)
    if not login:
        raise _no_wire(f"{truth.board} has no network port", "Remove tcp_port of this projector")
    return EmulatedNetworkProjector(
        lamp, board, port=truth.tcp_port, gate=GATES[login], password=truth.password, boot_s=boot_s
    )


def _no_wire(why: str, remedy: str) -> DeviceError:
    return DeviceError(
        "board-without-wire", what=f"A projector of {FILE_NAME} has the wrong wire: {why}.", remedy=f"{remedy}."
    )


_TIMING_S = {
    # An emulated projector answers at once, but the machine that it is emulated on may be loaded.
    "answer_s": 2.0,
    "late_s": 3.0,
    "command_s": 3.0,
    "confirm_s": 15.0,
    "interval_s": 0.005,
    "boot_interval_s": 0.05,
}


def quick_profile(lamp: LampTiming, *, base: str = "optoma-later", stable_s: float | None = None) -> str:
    """The TOML text of the shipped profile ``base`` with the times of an emulated lamp.

    ``stable_s`` is the time from strike to photometric stability (default: the warm-up time). Raises
    PluginError("profile-unchanged") if the shipped file lacks a key that must be shortened.
    """
    text = (resources.files("firmware_configs") / "projectors" / f"{base}.toml").read_text(encoding="utf-8")
    times = {
        **_TIMING_S,
        "warm_up_s": lamp.warm_up_s,
        "stable_s": max(lamp.warm_up_s, stable_s or 0.0),
        "cool_down_s": lamp.cool_down_s,
        "minimum_off_s": lamp.cool_down_s,
    }
    for key, seconds in times.items():
        text, count = re.subn(rf"(?m)^{key}\s*=\s*[0-9.]+.*$", f"{key} = {float(seconds)!r}", text)
        if count != 1:
            raise PluginError(
                "profile-unchanged",
                what=f"The shipped profile {base} does not set {key} once.",
                remedy="Reinstall velatura; the profile was changed.",
            )
    return f"# Written for an emulated stage: {base} with short times.\n{text}"
