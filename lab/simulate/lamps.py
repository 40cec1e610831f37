"""Simulated projectors: a lamp that remembers what was done to it, behind a control line on which things go wrong."""

from __future__ import annotations

import random
from typing import Final

from hal.deadline import Deadline
from hal.errors import DeviceBusy, DeviceError, DeviceGone, DeviceRefused, DeviceTimeout, ProtocolError
from hal.values import DeviceIdentity, LampRules, Power, ProjectorCapabilities, ProjectorStatus
from lab.simulate.scheduler import Lock, Scheduler

RULES: Final = LampRules(warm_up_s=20.0, stable_s=45.0, cool_down_s=30.0, minimum_off_s=60.0)
LINE_TROUBLES: Final = ("silent", "gone", "garbled", "refuses", "slow", "loses", "late", "doubles", "delays", "flaky")
SLOW_S: Final = 4.0
_ROUNDING_S: Final = 1e-6


class Lamp:
    """What the projector really is. ``dud``: it takes strikes and gives no light; ``fault``: a word that it reports;
    ``by_hand``: it burns because somebody switched it on;
    ``lasts_s``: after so long it goes out by itself, infinite for a good one; ``doubled``: strikes of ``strikes`` by
    the second of one command; ``late``: it burns because of a command that came late.

    ``sins``: what was done to it against the rules.
    """

    def __init__(self, name: str, scheduler: Scheduler) -> None:
        self.name, self._scheduler = name, scheduler
        self.lit_at_s: float | None = None
        self.off_at_s = self.struck_at_s = -1e9
        self.dud, self.by_hand, self.fault = False, False, ""
        self.lasts_s = float("inf")
        self.strikes = self.doubled = 0
        self.late = False
        self.violations: list[str] = []

    @property
    def bad(self) -> bool:
        """Whether no strike gives light that stays."""
        return self.dud or self.lasts_s != float("inf")

    @property
    def lit(self) -> bool:
        since_s = self.lit_at_s
        if since_s is not None and self._scheduler.now_s - since_s >= self.lasts_s:
            self.lit_at_s, self.off_at_s = None, since_s + self.lasts_s
        return self.lit_at_s is not None

    @property
    def shines(self) -> bool:
        return self.lit and self._scheduler.now_s - (self.lit_at_s or 0.0) >= RULES.warm_up_s

    def power(self) -> Power:
        if self.lit:
            return Power.ON if self.shines else Power.WARMING
        if self.fault:
            return Power.FAULT
        return Power.COOLING if self._scheduler.now_s - self.off_at_s < RULES.cool_down_s else Power.OFF

    def strike(self) -> None:
        if self.lit:
            return
        dark_s = self._scheduler.now_s - self.off_at_s
        if dark_s < RULES.minimum_off_s - _ROUNDING_S:
            self.violations.append(f"the lamp of {self.name} was struck {dark_s:.1f} s after it went off")
        self.strikes += 1
        self.lit_at_s = self.struck_at_s = self._scheduler.now_s
        self.by_hand = self.late = False
        if self.dud:
            self.go_dark()

    def go_dark(self) -> None:
        if self.lit:
            self.lit_at_s, self.off_at_s = None, self._scheduler.now_s


class Line:
    """The control line of one projector. ``trouble``: one of ``LINE_TROUBLES``, or empty.

    ``owner``: the opened device that has it; ``connection``: its number, another one once it broke. ``lingers_s``: it
    takes no new connection for so long after a program was killed that had one.
    """

    def __init__(self, lamp: Lamp, scheduler: Scheduler, rng: random.Random) -> None:
        self.lamp, self._scheduler, self._rng = lamp, scheduler, rng
        self.trouble = ""
        self.owner: SimulatedProjector | None = None
        self.connection = 0
        self.lingers_s, self._taken_until_s = 0.0, 0.0
        self.turn = Lock(scheduler, again=False)
        self._late: list[tuple[float, bool, bool]] = []
        """When it arrives, whether it switches on, and whether it is the second of one command."""

    def drop(self) -> None:
        """The program that had it was killed."""
        if self.owner is not None:
            self._taken_until_s = self._scheduler.now_s + self.lingers_s
        self.owner = None
        self.turn = Lock(self._scheduler, again=False)

    def let_go(self) -> None:
        """The projector was without power: it knows of no connection."""
        self._taken_until_s = 0.0

    @property
    def taken(self) -> bool:
        """Whether the projector still waits for a program that is gone."""
        return self._scheduler.now_s < self._taken_until_s

    @property
    def delayed(self) -> int:
        """Commands that are still under way."""
        return sum(not doubled for _, _, doubled in self._late)

    def pass_on(self) -> None:
        """What was delayed reaches the projector now, which refuses a strike while it is hot."""
        now_s = self._scheduler.now_s
        for one in [one for one in self._late if one[0] <= now_s]:
            self._late.remove(one)
            _, on, doubled = one
            if not on:
                self.lamp.go_dark()
            elif now_s - self.lamp.off_at_s >= RULES.minimum_off_s:
                before = self.lamp.strikes
                self.lamp.strike()
                struck = self.lamp.strikes - before
                self.lamp.late = self.lamp.late or struck > 0
                self.lamp.doubled += struck * doubled

    def talk(self, deadline: Deadline) -> None:
        """The question's way there and back. Raises what a line may raise."""
        self.pass_on()
        trouble = self.trouble
        if trouble == "gone":
            raise self._error(DeviceGone, "link-lost", "can't be reached")
        if trouble in ("silent", "slow", "flaky") and (trouble != "flaky" or self._rng.random() < 0.3):
            self._scheduler.sleep(min(deadline.left_s(), SLOW_S if trouble == "slow" else 1e6))
            if trouble != "slow" or deadline.passed:
                raise self._error(DeviceTimeout, "link-no-answer", "did not answer in time")
        else:
            self._scheduler.sleep(self._rng.uniform(0.01, 0.15))
        if trouble == "garbled" and self._rng.random() < 0.5:
            raise self._error(ProtocolError, "answer-wrong", "gave an answer that is none")

    def command(self, on: bool, deadline: Deadline) -> None:
        """Switch. Raises as ``talk``."""
        trouble, lamp = self.trouble, self.lamp
        do = lamp.strike if on else lamp.go_dark
        self.talk(deadline)
        if trouble == "refuses":
            raise self._error(DeviceRefused, "projector-not-now", "refuses to switch")
        if trouble == "loses" and self._rng.random() < 0.5:
            raise self._error(DeviceTimeout, "projector-not-confirmed", "did not switch in time")
        if trouble == "delays":
            self._late.append((self._scheduler.now_s + self._rng.uniform(1.0, 90.0), on, False))
            raise self._error(DeviceTimeout, "projector-not-confirmed", "did not switch in time")
        if on and lamp.power() is Power.COOLING:
            lamp.violations.append(f"the lamp of {lamp.name} was switched on while it cooled")
        do()
        if trouble == "doubles":
            self._late.append((self._scheduler.now_s + self._rng.uniform(0.1, 20.0), on, True))
        if trouble == "late":
            raise self._error(DeviceTimeout, "projector-not-confirmed", "did not switch in time")

    def _error(self, kind: type[DeviceError], code: str, doing: str) -> DeviceError:
        return kind(code, what=f"The projector {self.lamp.name} {doing}.", remedy="Check its cable.")


class SimulatedProjector:
    """An opened projector; see ``hal.interfaces.Projector``."""

    def __init__(self, line: Line, deadline: Deadline) -> None:
        self._line, self._closed, self._connection = line, False, line.connection
        if line.owner is not None:
            raise DeviceBusy("port-taken", what=f"The line of {line.lamp.name} is in use by another program.",
                             remedy="Stop that program.")  # fmt: skip
        if line.taken:
            raise DeviceGone("link-refused", what=f"The projector {line.lamp.name} takes no connection.",
                             remedy="Wait.")  # fmt: skip
        line.owner = self
        try:
            line.talk(deadline)
        except BaseException:
            line.owner = None
            raise

    @property
    def capabilities(self) -> ProjectorCapabilities:
        return ProjectorCapabilities(lamp_hours=False, shutter=False, inputs=(), errors=True, lamp_rules=RULES)

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        self._ask(deadline)
        return DeviceIdentity("Simulated", "Projector")

    def status(self, *, deadline: Deadline) -> ProjectorStatus:
        self._ask(deadline)
        lamp = self._line.lamp
        return ProjectorStatus(lamp.power(), (lamp.fault,) if lamp.fault else ())

    def switch_on(self, *, deadline: Deadline) -> None:
        self._ask(deadline, True)

    def switch_off(self, *, deadline: Deadline) -> None:
        self._ask(deadline, False)

    def set_shutter(self, closed: bool, *, deadline: Deadline) -> None:
        raise DeviceRefused("no-shutter", what="It has no shutter.", remedy="None is needed.")

    def close(self) -> None:
        self._closed = True
        if self._line.owner is self:
            self._line.owner = None

    def _ask(self, deadline: Deadline, on: bool | None = None) -> None:
        if self._closed:
            raise DeviceGone("projector-closed", what="The projector is no longer open.", remedy="Open it again.")
        with self._line.turn:
            if self._connection != self._line.connection:
                raise DeviceGone("link-lost", what=f"The connection to {self._line.lamp.name} broke.", remedy="Wait.")
            if on is None:
                self._line.talk(deadline)
            else:
                self._line.command(on, deadline)
