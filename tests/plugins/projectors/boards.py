"""The emulated control boards by the shipped profiles that speak to them."""

from __future__ import annotations

from collections.abc import Callable

from plugins.emulated.projectors.board_sanyo import SanyoBoard
from plugins.emulated.projectors.boards_binary import Ep910Board, NecBoard
from plugins.emulated.projectors.boards_text import BenqBoard, ChristieBoard, EpsonBoard, PanasonicBoard
from plugins.emulated.projectors.lamp import EmulatedLamp
from plugins.emulated.projectors.serial import Board

BOARDS: dict[str, Callable[[EmulatedLamp], Board]] = {
    "epson-escvp21": EpsonBoard,
    "benq": BenqBoard,
    "christie": ChristieBoard,
    "nec": NecBoard,
    "optoma-ep910": Ep910Board,
    "panasonic": PanasonicBoard,
    "sanyo": SanyoBoard,
}
"""All but the first, Optoma's, which an emulated projector has by itself."""
