"""The emulated control boards, by the shipped profiles that speak to them."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from importlib import resources
from typing import Final

from hal.errors import DeviceError
from plugins.emulated.projectors.board_sanyo import SanyoBoard
from plugins.emulated.projectors.boards_binary import Ep910Board, NecBoard
from plugins.emulated.projectors.boards_text import BenqBoard, ChristieBoard, EpsonBoard, PanasonicBoard
from plugins.emulated.projectors.lamp import EmulatedLamp
from plugins.emulated.projectors.optoma import OptomaBoard
from plugins.emulated.projectors.serial import Board

USUAL: Final = "optoma-later"
BOARDS: Final[Mapping[str, Callable[[EmulatedLamp], Board]]] = {
    USUAL: OptomaBoard,
    "epson-escvp21": EpsonBoard,
    "benq": BenqBoard,
    "christie": ChristieBoard,
    "nec": NecBoard,
    "optoma-ep910": Ep910Board,
    "panasonic": PanasonicBoard,
    "sanyo": SanyoBoard,
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
    """The usual baud rate of a family, from its shipped profile."""
    text = (resources.files("firmware_configs") / "projectors" / f"{family}.toml").read_text(encoding="utf-8")
    return int(tomllib.loads(text)["serial"]["baud"])
