"""Switches mains relays with the lamps: on while light is wanted, off when the lamps behind them have cooled."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from functools import partial
from typing import cast

from controller.kiosk.state import DeviceRow, LiveValue
from controller.kiosk.supervisors.device_supervisor import LOOK_S, DeviceSupervisor
from controller.kiosk.supervisors.projector_supervisor import ProjectorSupervisor
from controller.kiosk.world import World
from controller.stage.rig.lamp_guard import LampGuard
from controller.stage.rig.power import Circuit
from hal.deadline import Deadline
from hal.errors import DeviceError
from hal.interfaces import Device
from hal.notices import Notice
from hal.values import DeviceIdentity

Tell = Callable[[Notice], object]


class Boards:
    """Every relay board of a stage as one device."""

    def __init__(self, circuits: tuple[Circuit, ...], stack: contextlib.ExitStack) -> None:
        self.circuits, self._stack = circuits, stack

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        return DeviceIdentity("Velatura", "mains relays")

    def close(self) -> None:
        self._stack.close()


class MainsSupervisor(DeviceSupervisor):
    """Closes the relays while light is wanted, and opens each when the lamps behind it have cooled.

    A relay that fails, or a projector that is silent, does not delay the others.
    """

    def __init__(
        self, driver: str, open_it: Callable[[Deadline], Device], tell: Tell, world: World | None = None
    ) -> None:
        super().__init__(DeviceRow("relays", "relay", driver), open_it, self._switch, tell, every_s=2.0, world=world)
        self.want_on = True
        self.supervisors: tuple[ProjectorSupervisor, ...] = ()
        self._off: frozenset[str] = frozenset()
        self._booted_at_s: dict[str, float] = {}

    def silences(self, projector: str) -> bool:
        """Whether the projector has no mains, or is booting since it got them, so that it can't answer."""
        return projector in self._off or self._monotonic() < self._booted_at_s.get(projector, 0.0)

    def _switch(self, device: Device, deadline: Deadline) -> tuple[LiveValue, ...]:
        boards = cast("Boards", device)
        act: Callable[[Circuit], str]
        if self.want_on:
            # From now on the projectors are asked: one that stays without mains counts as lost, not as dark.
            self._off = frozenset()
            act = self._switch_on
        else:
            guards = {supervisor.name: supervisor.guard for supervisor in self.supervisors}
            act = partial(self._switch_off, guards=guards)
        values, failed = [], list[DeviceError]()
        for circuit in boards.circuits:
            try:
                values.append(LiveValue.said(circuit.name, act(circuit)))
            except DeviceError as error:
                failed.append(error)
        if failed:
            raise failed[0]
        return tuple(values)

    def _switch_on(self, circuit: Circuit) -> str:
        if circuit.close(deadline=self._deadline(LOOK_S)):
            self._tell(Notice("mains-on", f"Mains on: {circuit.name}."))
            self._booted_at_s |= dict.fromkeys(circuit.feeds, self._monotonic() + circuit.boot_s)
        return "on"

    def _switch_off(self, circuit: Circuit, guards: dict[str, LampGuard | None]) -> str:
        # The board is asked first, even if its state is known: a missing board must be reported as such, not as the
        # silence of the projectors that lost their mains with it.
        if not circuit.on(deadline=self._deadline(LOOK_S)):
            return self._is_off(circuit)
        self._off -= frozenset(circuit.feeds)  # closed by hand, or by another program
        known = {name: guard for name, guard in guards.items() if guard is not None}
        if any(name not in known for name in circuit.feeds):
            return "unchanged"
        try:
            circuit.open(known, deadline=self._deadline(LOOK_S))
        except DeviceError as error:
            if error.code == "mains-lamp-hot":
                return "on until the lamps have cooled"
            if not self._all_answer([known[name] for name in circuit.feeds]):
                return "on, because it is unknown whether the lamps have cooled"
            raise
        return self._is_off(circuit)

    def _is_off(self, circuit: Circuit) -> str:
        if not self._off.issuperset(circuit.feeds):
            self._off |= frozenset(circuit.feeds)
            self._tell(Notice("mains-off", f"Mains off: {circuit.name}."))
        return "off"

    def _all_answer(self, guards: Sequence[LampGuard]) -> bool:
        """Whether all these projectors answer; the supervisor of each reports its problems."""
        try:
            for guard in guards:
                guard.status(deadline=self._deadline(guard.answer_s))
        except DeviceError:
            return False
        return True
