"""The lamp rules, between every caller and the projectors. No other code uses a projector without them.

- A lamp is never struck while it cools, or before its minimum off time is over.
- After a power cut or a kill, or when a lamp is found to be off by itself, it counts as hot from that moment.
- Strikes are counted before they happen, hours while they pass; both survive restarts.
- A mains relay opens only after cooling; photometric work begins only when the lamp is stable.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import Final

from controller.stage.rig.lamp_ledger import Clock, LampLedger, LampRecord, SystemClock
from hal.deadline import Deadline
from hal.errors import DeviceRefused
from hal.interfaces import AdjustedProjector, Projector, WatchedProjector
from hal.notices import Notice
from hal.values import DeviceIdentity, LampRules, Power, ProjectorCapabilities, ProjectorStatus

START_AGAIN: Final = "Then start the same command or job again: it continues where it stopped."
_REMEDIES = {
    "lamp": "Let it cool for some minutes. If the fault returns, replace the lamp.",
    "temperature": "Clear its air inlets, clean the filter, and let it cool for 45 minutes before the next start.",
    "cover": "Close its cover.",
    "fan": "Check that its fans turn. If not, have it repaired.",
    "filter": "Clean or replace its air filter.",
}


def fatal_faults(status: ProjectorStatus) -> tuple[str, ...]:
    """Faults that stop the work; those that end in ``-warning`` (lamp hours, a filter) do not."""
    return tuple(fault for fault in status.faults if not fault.endswith("-warning"))


def faulty(name: str, status: ProjectorStatus, *, then: str = "") -> DeviceRefused:
    """The error for a projector that reports faults; ``then``: what to do after the remedy."""
    faults = ", ".join(status.faults) or "a fault without a name"
    remedy = next((text for word, text in _REMEDIES.items() if word in faults), "Check its display and its manual.")
    return DeviceRefused(
        "projector-fault", what=f"Projector {name} reports {faults}.", remedy=f"{remedy} {then}".strip()
    )


SAVE_HOURS_EVERY_S = 60.0
ANSWER_S = 10.0
"""Wait at least so long for one answer, even if the driver gives less."""


@dataclass(frozen=True, slots=True)
class LampUse:
    """A lamp's use by this program: strikes, and hours lit."""

    strikes: int
    hours: float


class LampGuard:
    """Wraps a driver's ``Projector`` and keeps the lamp rules.

    Parameters
    ----------
    name : the projector's name in stage.toml and in the ledger
    at_least : rules of the stage; each may be stricter than the device's own, never less strict
    lock : one that may be taken again by the thread that has it; default: a ``threading.RLock``
    """

    def __init__(
        self,
        name: str,
        projector: Projector,
        ledger: LampLedger,
        *,
        at_least: LampRules | None = None,
        clock: Clock | None = None,
        lock: AbstractContextManager[object] | None = None,
    ) -> None:
        self.name = name
        self._projector = projector
        self._ledger = ledger
        self._clock = clock or SystemClock()
        self._known = projector.capabilities
        # Once: looking at a protocol takes longer than all else that a status needs of the processor.
        self._watched = projector if isinstance(projector, WatchedProjector) else None
        self._rules = stricter(self._known.lamp_rules, at_least)
        self._lock: AbstractContextManager[object] = lock or threading.RLock()
        self._record = self._remembered()
        self._born_s = self._counted_s = self._clock.now_s()
        self._unsaved_s = 0.0
        self._durable = True

    # -- hal.interfaces.Projector

    @property
    def capabilities(self) -> ProjectorCapabilities:
        return replace(self._can, lamp_rules=self._rules)

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        return self._projector.identity(deadline=deadline)

    def close(self) -> None:
        """Close the connection. The lamp stays as it is."""
        with self._lock:
            self._count()
            if self._unsaved_s > 0 or not self._durable:
                self._write_quietly(self._record)
        self._projector.close()

    def set_shutter(self, closed: bool, *, deadline: Deadline) -> None:
        self._projector.set_shutter(closed, deadline=deadline)

    def status(self, *, deadline: Deadline) -> ProjectorStatus:
        """The device's answer now; it is also written to the lamp's record.

        A projector that only a person can switch counts as on after ``switched_by_hand``, unless it reports otherwise.
        """
        with self._lock:
            status = self._projector.status(deadline=deadline)
            self._seen(status.power)
            if not self._durable:
                self._write_quietly(self._record)
            since_s = self._record.since_s
            if self.by_hand and status.power is Power.UNKNOWN and self._record.lit:
                burns = since_s is not None and self._now() >= since_s
                return replace(status, power=Power.ON if burns else Power.WARMING)
            return status

    def notices(self) -> list[Notice]:
        """As ``hal.interfaces.WatchedProjector``; empty if the driver reports none."""
        return [] if self._watched is None else self._watched.notices()

    def adjustments(self, *, deadline: Deadline) -> dict[str, str]:
        """As ``hal.interfaces.AdjustedProjector``; empty if the driver reads none."""
        projector = self._projector
        return projector.adjustments(deadline=deadline) if isinstance(projector, AdjustedProjector) else {}

    def switch_on(self, *, deadline: Deadline, failed: int | None = None) -> None:
        """Strike the lamp if the rules allow; no effect if it is lit. ``failed``: as for ``keep_failed``.

        Raises DeviceRefused with code "lamp-cooling", "lamp-resting", "lamp-state-unknown" or "projector-fault" before
        anything is sent, and WorkError if the strike can't be recorded (then nothing is sent either).
        """
        with self._lock:
            status = self.status(deadline=deadline)
            if status.power in (Power.ON, Power.WARMING):
                return
            self._refuse_unless_cold(status)
            before = self._record
            struck = replace(before, lit=True, since_s=self._now(), boot=self._boot(), strikes=before.strikes + 1)
            self._write(struck if failed is None else replace(struck, failed=failed))
            try:
                self._projector.switch_on(deadline=deadline)
            except DeviceRefused:
                # Only a refusal proves that the lamp was not struck; without an answer it counts as struck.
                self._write(replace(before, lit_s=self._record.lit_s))
                raise

    def switch_off(self, *, deadline: Deadline) -> None:
        """Switch to standby. The command is sent even if checking the lamp or the ledger fails.

        That error is not lost: ``power_down`` and the kiosk check again afterwards.
        """
        with self._lock:
            power = Power.UNKNOWN
            interrupted: KeyboardInterrupt | None = None
            try:
                power = self.status(deadline=deadline.within(deadline.left_s() / 3)).power
            except BaseException as error:  # noqa: BLE001 - see above
                interrupted = error if isinstance(error, KeyboardInterrupt) else None
            self._projector.switch_off(deadline=deadline)
            if interrupted is not None:
                raise interrupted
            if self._record.lit or power not in (Power.OFF, Power.COOLING):
                self._went_off()

    def keep_failed(self, count: int) -> None:
        """Keep how many attempts in a row gave no light, so that a restart does not start the count again."""
        with self._lock:
            if self._record.failed != count:
                self._write_quietly(replace(self._record, failed=count))

    # -- projectors that only a person can switch

    @property
    def by_hand(self) -> bool:
        """Whether the codes to switch this projector are unknown."""
        return not self._can.power

    def switched_by_hand(self, on: bool, *, in_s: float = 0.0) -> None:
        """A technician was asked to switch it, which is assumed to be done in ``in_s`` seconds."""
        with self._lock:
            if on and not self._record.lit:
                strikes = self._record.strikes + 1
                since_s = self._now() + in_s
                self._write(replace(self._record, lit=True, since_s=since_s, boot=self._boot(), strikes=strikes))
            elif not on and self._record.lit:
                self._went_off()

    # -- the rules

    @property
    def answer_s(self) -> float:
        """How long to wait for one answer: the driver's value, at least ``ANSWER_S``."""
        return max(ANSWER_S, self._can.answer_s)

    @property
    def switch_s(self) -> float:
        """How long to wait until a switch is confirmed; some projectors do not answer while they start."""
        return max(ANSWER_S, self._can.switch_s)

    @property
    def may_be_lit(self) -> bool:
        """Whether the lamp was struck or seen on, and not seen off since."""
        return self._record.lit

    def rest_left_s(self) -> float:
        """Seconds until the rules allow a strike by time; 0 for a lamp that is lit or was never seen."""
        with self._lock:
            if self._record.lit or self._record.since_s is None:
                return 0.0
            return max(0.0, self._record.since_s + self._rest_s() - self._now())

    def stable_left_s(self) -> float:
        """Seconds until photometric work is allowed; infinite while the lamp is not lit."""
        with self._lock:
            if not self._record.lit or self._record.since_s is None:
                return float("inf")
            return max(0.0, self._record.since_s + self._rules.stable_s - self._now())

    def may_open_mains(self, *, deadline: Deadline) -> bool:
        """Whether the projector is in standby and has cooled long enough to cut its mains."""
        if self.status(deadline=deadline).power is not Power.OFF:
            return False
        with self._lock:
            # A lamp without a record may have been switched off just before this program started.
            off_since_s = self._born_s if self._record.since_s is None else self._record.since_s
            return not self._record.lit and self._now() - off_since_s >= self._rules.cool_down_s

    @contextlib.contextmanager
    def unstruck(self) -> Iterator[None]:
        """Inside, no other thread strikes the lamp, and ``may_be_lit`` does not change."""
        with self._lock:
            yield

    def use(self) -> LampUse:
        """Strikes and hours so far."""
        with self._lock:
            return LampUse(self._record.strikes, (self._record.lit_s + self._unsaved_s) / 3600)

    # -- inside

    @property
    def _can(self) -> ProjectorCapabilities:
        """The driver's capabilities; the last known ones if the query fails, because switching off needs them."""
        with contextlib.suppress(Exception):
            self._known = self._projector.capabilities
        return self._known

    def _refuse_unless_cold(self, status: ProjectorStatus) -> None:
        if status.power is Power.COOLING:
            raise DeviceRefused(
                "lamp-cooling",
                what=f"The lamp of projector {self.name} is cooling and must not be struck.",
                remedy=f"Wait about {self._rules.cool_down_s:.0f} s and start again.",
            )
        if status.power is Power.FAULT:
            raise faulty(self.name, status)
        if status.power is not Power.OFF:
            raise DeviceRefused(
                "lamp-state-unknown",
                what=f"Projector {self.name} does not report whether its lamp is hot.",
                remedy="Switch it on with its own remote control, or check its profile in stage.toml.",
            )
        if (rest_s := self.rest_left_s()) > 0:
            raise DeviceRefused(
                "lamp-resting",
                what=f"The lamp of projector {self.name} was on recently. It must stay off for a minimum time.",
                remedy=f"Wait {rest_s:.0f} s and start again.",
            )

    def _rest_s(self) -> float:
        return max(self._rules.minimum_off_s, self._rules.cool_down_s)

    def _remembered(self) -> LampRecord:
        record = self._ledger.read(self.name)
        if record is None:
            return LampRecord()
        if record.boot == self._boot() and record.since_s is not None:
            return record
        # The clock of another boot can't be compared: the lamp counts as hot from now.
        return replace(record, since_s=self._now(), boot=self._boot(), failed=0)

    def _seen(self, power: Power) -> None:
        self._count()
        lit = self._record.lit
        if power in (Power.ON, Power.WARMING) and not lit:
            # It was switched on elsewhere: its time on is unknown, so count from now.
            self._write_quietly(replace(self._record, lit=True, since_s=self._now(), boot=self._boot()))
        elif power in (Power.OFF, Power.COOLING) and lit:
            self._went_off()
        elif power is Power.COOLING and self._cooled_by_now():
            # It was switched on elsewhere between two checks, or cools longer than its rules state.
            self._went_off()

    def _cooled_by_now(self) -> bool:
        since_s = self._record.since_s
        return since_s is None or self._now() - since_s > self._rules.cool_down_s

    def _went_off(self) -> None:
        self._count()
        self._write_quietly(replace(self._record, lit=False, since_s=self._now(), boot=self._boot()))

    def _count(self) -> None:
        now_s = self._now()
        if self._record.lit:
            self._unsaved_s += now_s - self._counted_s
        self._counted_s = now_s
        if self._unsaved_s >= SAVE_HOURS_EVERY_S:
            self._write_quietly(self._record)

    def _write(self, record: LampRecord) -> None:
        record = self._with_hours(record)
        self._ledger.write(self.name, record)
        self._record, self._unsaved_s, self._durable = record, 0.0, True

    def _write_quietly(self, record: LampRecord) -> None:
        """Record what has happened: always in memory, and on disk if possible (each status tries again).

        A restart knows what is on disk alone: of a lamp that was switched on elsewhere, not that it is hot.
        """
        self._record, self._unsaved_s = self._with_hours(record), 0.0
        self._durable = self._ledger.keep(self.name, self._record)

    def _with_hours(self, record: LampRecord) -> LampRecord:
        return replace(record, lit_s=record.lit_s + self._unsaved_s)

    def _now(self) -> float:
        return self._clock.now_s()

    def _boot(self) -> str:
        return self._clock.boot()


def stricter(rules: LampRules, at_least: LampRules | None) -> LampRules:
    """The longer of both times, for each time."""
    if at_least is None:
        return rules
    return LampRules(
        warm_up_s=max(rules.warm_up_s, at_least.warm_up_s),
        stable_s=max(rules.stable_s, at_least.stable_s),
        cool_down_s=max(rules.cool_down_s, at_least.cool_down_s),
        minimum_off_s=max(rules.minimum_off_s, at_least.minimum_off_s),
    )
