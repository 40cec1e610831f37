"""Mains relays: closed before the projectors are used, opened only when every lamp behind them has cooled."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from controller.stage.rig.lamp_guard import ANSWER_S, LampGuard
from controller.stage.rig.lamp_ledger import Clock, SystemClock
from controller.stage.rig.power import POLL_S
from hal.deadline import Deadline, in_seconds
from hal.errors import DeviceRefused
from hal.interfaces import PowerSwitch

MARGIN_S = 60.0
"""Beyond the longest cooling time of its lamps' rules, a projector gets this long to report standby."""


@dataclass(frozen=True, slots=True)
class Circuit:
    """One relay, and the names of the projectors that it feeds. ``boot_s``: time until they accept commands."""

    name: str
    channel: int
    feeds: tuple[str, ...]
    boot_s: float
    _switch: PowerSwitch = field(repr=False)

    def on(self, *, deadline: Deadline) -> bool:
        """Whether its relay is closed now, according to the board."""
        return self._switch.state(self.channel, deadline=deadline)

    def close(self, *, deadline: Deadline) -> bool:
        """Switch the mains on; returns whether they were off before."""
        if self.on(deadline=deadline):
            return False
        self._switch.switch(self.channel, True, deadline=deadline)
        return True

    def open(self, guards: Mapping[str, LampGuard], *, deadline: Deadline) -> None:
        """Switch the mains off; no effect if they are off.

        Raises DeviceRefused("mains-lamp-hot") unless every lamp behind it is known to be cold.
        """
        if not self._switch.state(self.channel, deadline=deadline):
            return  # no projector behind it could answer
        self._refuse([name for name in self.feeds if not guards[name].may_open_mains(deadline=deadline)])
        with contextlib.ExitStack() as held:
            for name in self.feeds:
                held.enter_context(guards[name].unstruck())
            # Another thread did it after the check.
            self._refuse([name for name in self.feeds if guards[name].may_be_lit])
            self._switch.switch(self.channel, False, deadline=deadline)

    def _refuse(self, hot: Sequence[str]) -> None:
        if hot:
            raise DeviceRefused(
                "mains-lamp-hot",
                what=f"Relay {self.name} stays closed: the lamp of {', '.join(hot)} is lit or has not cooled.",
                remedy="Switch the projector off and wait until its fans stop.",
            )


@dataclass(frozen=True, slots=True)
class MainsFailure:
    """A circuit that stayed closed, and why."""

    circuit: str
    error: Exception


def close_circuits(circuits: Sequence[Circuit], *, deadline: Deadline, clock: Clock | None = None) -> None:
    """Close every relay, and wait until the projectors that had no mains accept commands.

    Raises what the relays' drivers raise, and Cancelled.
    """
    fresh = [circuit for circuit in circuits if circuit.close(deadline=deadline.within(ANSWER_S))]
    if fresh:
        (clock or SystemClock()).sleep(max(circuit.boot_s for circuit in fresh), deadline)


def open_circuits(
    circuits: Sequence[Circuit], guards: Sequence[LampGuard], *, within_s: float | None = None,
    clock: Clock | None = None,
) -> tuple[MainsFailure, ...]:  # fmt: skip
    """Open every relay as soon as each lamp behind it has cooled; call after ``power_down``.

    Its time limit is ``within_s``, or the time of the lamps' rules plus a minute. A relay whose lamps are not
    known to be cold by then stays closed and is returned as a failure. Raises nothing.
    """
    clock = clock or SystemClock()
    named = {guard.name: guard for guard in guards}
    if within_s is None:
        cool_downs = [guard.capabilities.lamp_rules.cool_down_s for guard in guards]
        within_s = max(cool_downs, default=0.0) + MARGIN_S
    until_s = clock.now_s() + within_s
    waiting, last = list(circuits), dict[str, Exception]()
    while waiting:
        for circuit in tuple(waiting):
            try:
                circuit.open(named, deadline=in_seconds(sum(named[name].answer_s for name in circuit.feeds)))
                waiting.remove(circuit)
            except Exception as error:  # noqa: BLE001 - returned; one broken relay must not keep the others waiting
                last[circuit.name] = error
        if not waiting or clock.now_s() >= until_s:
            break
        clock.sleep(POLL_S, in_seconds(POLL_S * 2))
    return tuple(MainsFailure(circuit.name, last[circuit.name]) for circuit in waiting)
