"""Mains relays that follow the lamps: closed while light is wanted, opened when what is behind them has cooled."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import cast

from controller.panel.kiosk import LiveValue
from controller.serve.device_keeper import DeviceKeeper
from controller.serve.eventlog import Decision
from controller.serve.projector_keeper import ProjectorKeeper
from controller.session.mains import Circuit
from controller.session.safety import LampGuard
from hal.deadline import Deadline
from hal.errors import DeviceError
from hal.interfaces import Device
from hal.values import DeviceIdentity

Tell = Callable[[Decision], object]


class Boards:
    """Every relay board of a stage as one device."""

    def __init__(self, circuits: tuple[Circuit, ...], stack: contextlib.ExitStack) -> None:
        self.circuits, self._stack = circuits, stack

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        return DeviceIdentity("Velatura", "mains relays")

    def close(self) -> None:
        self._stack.close()


class MainsKeeper(DeviceKeeper):
    """Closes the relays while light is wanted, and opens each once the lamps behind it have cooled."""

    def __init__(self, driver: str, open_it: Callable[[Deadline], Device], tell: Tell) -> None:
        super().__init__("relays", "relay", driver, open_it, self._switch, tell, every_s=2.0)
        self.want_on = True
        self.keepers: tuple[ProjectorKeeper, ...] = ()
        self._off: frozenset[str] = frozenset()
        self._booted_at_s: dict[str, float] = {}

    def silences(self, projector: str) -> bool:
        """Whether the projector has no mains, or boots because it just got them: nobody need ask it anything."""
        return projector in self._off or self._monotonic() < self._booted_at_s.get(projector, 0.0)

    def _switch(self, device: Device, deadline: Deadline) -> tuple[LiveValue, ...]:
        boards = cast("Boards", device)
        if self.want_on:
            for circuit in boards.circuits:
                if circuit.close(deadline=deadline):
                    self._tell(Decision("mains-on", f"Mains on: {circuit.name}."))
                    ready_s = self._monotonic() + circuit.boot_s
                    self._booted_at_s |= dict.fromkeys(circuit.feeds, ready_s)
            self._off = frozenset()
            return tuple(LiveValue(circuit.name, "on") for circuit in boards.circuits)
        guards = {keeper.name: keeper.guard for keeper in self.keepers}
        values = []
        for circuit in boards.circuits:
            values.append(LiveValue(circuit.name, self._cut(circuit, guards, deadline)))
        return tuple(values)

    def _cut(self, circuit: Circuit, guards: dict[str, LampGuard | None], deadline: Deadline) -> str:
        if self._off.issuperset(circuit.feeds):
            return "off"
        known = {name: guard for name, guard in guards.items() if guard is not None}
        if any(name not in known for name in circuit.feeds):
            return "as it was"
        try:
            circuit.open(known, deadline=deadline)
        except DeviceError as error:
            if error.code != "mains-lamp-hot":
                raise
            return "on until the lamps have cooled"
        self._off |= frozenset(circuit.feeds)
        self._tell(Decision("mains-off", f"Mains off: {circuit.name}."))
        return "off"
