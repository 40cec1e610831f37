"""The emulated control boards by the shipped profiles that speak to them, and a projector of bench.toml on its wire."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from importlib import resources
from pathlib import Path
from typing import Any, Final, TypeAlias

from hal.errors import DeviceError
from lab.emulated.projectors.boards_binary import (
    Ep910Board,
    HitachiBoard,
    JvcBoard,
    NecBoard,
    SdcpBoard,
    ViewSonicBoard,
)
from lab.emulated.projectors.boards_marked import BarcoPulseBoard, ChristieBoard, PanasonicBoard, PanasonicDzBoard
from lab.emulated.projectors.boards_text import (
    AcerBoard,
    AdcpBoard,
    BenqBoard,
    DigitalProjectionBoard,
    DigitalProjectionVBoard,
    EpsonBoard,
    SanyoBoard,
)
from lab.emulated.projectors.network import GATES, EmulatedNetworkProjector
from plugins.emulated.core.truth import DEFAULT_BOARD, FILE_NAME, ProjectorTruth
from plugins.emulated.projectors.board import Board, OptomaBoard
from plugins.emulated.projectors.lamp import EmulatedLamp
from plugins.emulated.projectors.serial import EmulatedSerialProjector

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
            remedy=f"Choose one of {', '.join(BOARDS)}, or add it to lab/emulated/projectors/boards.py.",
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
