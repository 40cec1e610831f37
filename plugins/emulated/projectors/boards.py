"""The emulated control boards, by the shipped profiles that speak to them."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from importlib import resources
from typing import Any, Final

from hal.errors import DeviceError
from plugins.emulated.projectors.boards_binary import Ep910Board, NecBoard
from plugins.emulated.projectors.boards_text import BenqBoard, ChristieBoard, EpsonBoard, PanasonicBoard
from plugins.emulated.projectors.families.acer import AcerBoard
from plugins.emulated.projectors.families.barco import BarcoPulseBoard
from plugins.emulated.projectors.families.digital_projection import DigitalProjectionBoard, DigitalProjectionVBoard
from plugins.emulated.projectors.families.hitachi import HitachiBoard
from plugins.emulated.projectors.families.jvc import JvcBoard
from plugins.emulated.projectors.families.panasonic_dz import PanasonicDzBoard
from plugins.emulated.projectors.families.sanyo import SanyoBoard
from plugins.emulated.projectors.families.sony import AdcpBoard, SdcpBoard
from plugins.emulated.projectors.families.viewsonic import ViewSonicBoard
from plugins.emulated.projectors.lamp import EmulatedLamp
from plugins.emulated.projectors.optoma import OptomaBoard
from plugins.emulated.projectors.serial import Board

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
