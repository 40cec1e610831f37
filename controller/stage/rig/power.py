"""Switches all projectors on or off, and their mains: procedures that need every lamp guard at once.

Mains relays are closed before the projectors are used, and opened only when every lamp behind them has cooled.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

from controller.stage.rig.lamp_guard import ANSWER_S, START_AGAIN, LampGuard, fatal_faults, faulty
from controller.stage.rig.lamp_ledger import Clock, SystemClock
from hal.deadline import Cancelled, Deadline, in_seconds
from hal.errors import DeviceBusy, DeviceRefused, DeviceTimeout, ProtocolError
from hal.interfaces import PowerSwitch
from hal.values import Power

POLL_S = 1.0
"""Time between two queries of a projector; some hang when they are asked more often during boot."""
BY_HAND_S = 60.0
"""Time for a technician to reach a projector that only a person can switch."""

Advance = Callable[[float, str], None]
"""Fraction of the whole (0..1) and what is waited for."""
Tell = Callable[[str], None]
"""A sentence for the technician."""


@dataclass(frozen=True, slots=True)
class PowerFailure:
    """A projector that could not be switched off."""

    projector: str
    error: BaseException


def light(
    guards: Sequence[LampGuard], *, deadline: Deadline, advance: Advance, clock: Clock | None = None,
    tell: Tell = lambda sentence: None,
) -> None:  # fmt: skip
    """Strike every lamp and wait until each projector says that it is on.

    Waits for lamps in their minimum off time. Every projector is checked before any lamp is struck, and all are struck
    before waiting for any. The technician is asked to switch those that only a person can switch, and has
    ``BY_HAND_S`` for it.

    Raises
    ------
    DeviceRefused("projector-fault")  a projector reports a fault, at any time
    DeviceTimeout("lamps-not-lit")  the deadline passed
    Cancelled  the lamps are then as they were: call ``power_down``
    and what a driver raises at the first check, so that a silent projector is named at once
    """
    clock = clock or SystemClock()
    for guard in guards:
        _check(guard, deadline)
    for guard in guards:
        _strike(guard, deadline, advance, clock, tell)
    while waiting := [guard.name for guard in guards if not _is_on(guard, deadline)]:
        names = ", ".join(waiting)
        advance(1 - len(waiting) / len(guards), f"waiting for the light of {names}")
        deadline.check(
            "lamps-not-lit",
            what=f"The lamp of {names} did not come on in time.",
            remedy="Check that the projector has power and its cover is closed. Then start again.",
        )
        clock.sleep(POLL_S, deadline)


def steady(
    guards: Sequence[LampGuard], *, deadline: Deadline, advance: Advance, clock: Clock | None = None,
    but_s: float = 0.0,
) -> None:  # fmt: skip
    """Wait until every lamp has been on for its ``stable_s`` but the last ``but_s``, and watch for faults meanwhile.

    Raises DeviceRefused("projector-fault", "lamp-went-off"), DeviceTimeout("lamps-not-stable") and Cancelled.
    """
    clock = clock or SystemClock()
    wait_s = _stable_in_s(guards) - but_s
    while True:
        for guard in guards:
            if not _is_on(guard, deadline) and not guard.may_be_lit:
                raise DeviceRefused(
                    "lamp-went-off",
                    what=f"The lamp of projector {guard.name} went off while it was warming up.",
                    remedy=f"Let it cool for some minutes. If it goes off again, replace the lamp. {START_AGAIN}",
                )
        left_s = _stable_in_s(guards) - but_s
        if left_s <= 0:
            return
        advance(max(0.0, 1 - left_s / wait_s), f"the lamps become steady, {left_s:.0f} s")
        deadline.check(
            "lamps-not-stable",
            what="The lamps did not become stable in time.",
            remedy="Increase power_up_s under [safety] in stage.toml.",
        )
        clock.sleep(min(POLL_S, max(left_s, 0.01)), deadline)


def _stable_in_s(guards: Sequence[LampGuard]) -> float:
    return max((guard.stable_left_s() for guard in guards), default=0.0)


def power_down(
    guards: Sequence[LampGuard], *, within_s: float = 60.0, clock: Clock | None = None
) -> tuple[PowerFailure, ...]:
    """Switch all projectors off at once, each until it is seen cooling or off, or ``within_s`` has passed.

    A cancelled or overdue run does not stop it: it has its own time. A failing projector never keeps the others lit.
    Those that only a person can switch are left to the technician; the caller must ask for it.
    Returns the failures, empty when every lamp is off or cooling; raises nothing.
    """
    if not guards:
        return ()
    the_clock = clock or SystemClock()

    def attempt(guard: LampGuard) -> PowerFailure | None:
        try:
            if guard.by_hand:
                guard.switched_by_hand(False)
                return None
            _switch_off(guard, in_seconds(within_s), the_clock)
        except BaseException as error:  # noqa: BLE001 - returned; one broken driver must not keep the other lamps lit
            return PowerFailure(guard.name, error)
        return None

    with ThreadPoolExecutor(len(guards), thread_name_prefix="power-down") as pool:
        return tuple(failure for failure in pool.map(attempt, guards) if failure is not None)


def _check(guard: LampGuard, deadline: Deadline) -> None:
    try:
        status = guard.status(deadline=deadline.within(guard.answer_s))
    except DeviceBusy:
        return  # it is there
    if status.power is Power.FAULT or fatal_faults(status):
        raise faulty(guard.name, status, then=START_AGAIN)


def _strike(guard: LampGuard, deadline: Deadline, advance: Advance, clock: Clock, tell: Tell) -> None:
    if guard.by_hand:
        return _by_hand(guard, deadline, advance, clock, tell)
    while True:
        try:
            return guard.switch_on(deadline=deadline.within(guard.switch_s))
        except (DeviceRefused, DeviceBusy) as error:
            # One that is busy does not report its power state for a while.
            if error.code not in ("lamp-resting", "lamp-cooling", "projector-busy"):
                raise
            deadline.check(error.code, what=error.what, remedy=error.remedy)
            _rest(guard, guard.rest_left_s(), deadline, advance, clock)


def _by_hand(guard: LampGuard, deadline: Deadline, advance: Advance, clock: Clock, tell: Tell) -> None:
    """Also for one that should be on: it may have been switched off since a killed run."""
    while (left_s := guard.rest_left_s()) > 0:
        _rest(guard, left_s, deadline, advance, clock)
    within = "" if guard.may_be_lit else f" It is expected to be on in {BY_HAND_S:.0f} s."
    tell(f"Switch projector {guard.name} on with its remote control, if it is off. Velatura can't switch it.{within}")
    guard.switched_by_hand(True, in_s=BY_HAND_S)


def _rest(guard: LampGuard, left_s: float, deadline: Deadline, advance: Advance, clock: Clock) -> None:
    advance(0.0, f"the lamp of {guard.name} must stay off for {left_s:.0f} s")
    deadline.check(
        "lamp-resting",
        what=f"The lamp of projector {guard.name} was still in its minimum off time at the deadline.",
        remedy="Start again in some minutes.",
    )
    clock.sleep(POLL_S, deadline)


def _is_on(guard: LampGuard, deadline: Deadline) -> bool:
    """Whether the lamp is on. A booting projector may be silent or answer nonsense: that is not a failure yet."""
    try:
        status = guard.status(deadline=deadline.within(guard.answer_s))
    except (DeviceTimeout, DeviceBusy, ProtocolError):
        return False
    if status.power is Power.FAULT or fatal_faults(status):
        raise faulty(guard.name, status, then=START_AGAIN)
    return status.power is Power.ON


def _switch_off(guard: LampGuard, deadline: Deadline, clock: Clock) -> None:
    """Send the off command until the lamp is off or cooling; a warming projector may refuse for a while.

    One that was never seen lit is asked once: a silent projector must not delay the end of a failed run. One that
    reports a fault after the command is dark, and may report it for ever.
    """
    last: Exception | None = None
    answered = False
    while True:
        try:
            guard.switch_off(deadline=deadline.within(guard.switch_s))
            power = guard.status(deadline=deadline.within(guard.answer_s)).power
            if power in (Power.OFF, Power.COOLING) or (power is Power.FAULT and not guard.may_be_lit):
                return
            answered, last = True, None
        except Cancelled:
            raise
        except Exception as error:  # noqa: BLE001 - in every case the lamp must go off; reported at the time limit
            # If it answered before, only the time limit cut this answer off: it is still on.
            last = None if answered and deadline.passed else error
        if deadline.passed or (last is not None and not guard.may_be_lit):
            raise last or DeviceTimeout(
                "lamp-not-off",
                what=f"Projector {guard.name} is still on after the off command.",
                remedy="Switch it off with its own remote control. Leave its mains on until its fans stop.",
            )
        clock.sleep(POLL_S, deadline)


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
