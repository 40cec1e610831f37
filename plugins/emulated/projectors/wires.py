"""A projector of bench.toml on its wire: a serial line, or its own LAN port."""

from __future__ import annotations

from pathlib import Path
from typing import TypeAlias

from hal.errors import DeviceError
from plugins.emulated.optics.truth import FILE_NAME, ProjectorTruth
from plugins.emulated.projectors.boards import baud_of, board_named, login_of
from plugins.emulated.projectors.lamp import EmulatedLamp
from plugins.emulated.projectors.network.gates import GATES
from plugins.emulated.projectors.network.server import EmulatedNetworkProjector
from plugins.emulated.projectors.serial import EmulatedSerialProjector

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
