"""What emulated projectors have in common, whatever their wire: lamp, faults, a control board that may hang, mains."""

from __future__ import annotations

import copy
import time

from plugins.emulated.core.faults import Faults, FaultScript
from plugins.emulated.core.servers import Switchable
from plugins.emulated.projectors.board import Board
from plugins.emulated.projectors.lamp import EmulatedLamp, LampPhase


class EmulatedProjector(Switchable):
    """``faults`` are its knobs, ``scenario`` a script that turns them.

    ``wedges_below_s``: with two commands within this time while its lamp warms or cools, it hangs: ``wedged`` is true.
    """

    def __init__(self, lamp: EmulatedLamp, *, wedges_below_s: float) -> None:
        self.lamp = lamp
        self.faults = Faults()
        self.scenario: FaultScript | None = None
        self.wedged = False
        self._wedges_below_s = wedges_below_s
        self._heard_at_s = 0.0

    def _hang_if_too_soon(self) -> None:
        """Hang if a command follows the last one too soon, while the control board is busy with the lamp."""
        now_s, before_s = time.monotonic(), self._heard_at_s
        self._heard_at_s = now_s
        busy = self.lamp.phase in (LampPhase.WARMING, LampPhase.COOLING)
        self.wedged |= busy and now_s - before_s < self._wedges_below_s


class BoardProjector(EmulatedProjector):
    """One with a control ``board``, whose mains may be cut.

    ``boot_s``: from mains on until the board answers; a board that hangs answers again after that
    """

    def __init__(self, lamp: EmulatedLamp, board: Board, *, wedges_below_s: float, boot_s: float) -> None:
        super().__init__(lamp, wedges_below_s=wedges_below_s)
        self._board = board
        self._new_board = self._copied(board)
        self._boot_s = boot_s
        self._awake_at_s: float | None = time.monotonic()

    @property
    def awake(self) -> bool:
        """Whether it has mains, and has booted."""
        awake_at_s = self._awake_at_s
        return awake_at_s is not None and time.monotonic() >= awake_at_s

    def cut_mains(self) -> None:
        """The projector is dead. See ``lamp.damages``."""
        self._awake_at_s = None
        self.lamp.cut_mains()

    def restore_mains(self) -> None:
        """It boots for ``boot_s`` into standby, and has forgotten whatever it had heard."""
        if self._awake_at_s is None:
            self.wedged = False
            self._board = self._copied(self._new_board)
            self.lamp.restore_mains()
            self._awake_at_s = time.monotonic() + self._boot_s

    def _copied(self, board: Board) -> Board:
        """Another board of this kind, on the same lamp."""
        return copy.deepcopy(board, {id(self.lamp): self.lamp})
