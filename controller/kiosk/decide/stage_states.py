"""Which state the stage is in: what projectors report, and the need for light, move its state machine."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Final

from controller.kiosk.decide.interfaces import DISK_FULL, Condition, ProjectorView
from controller.kiosk.store.event_log import EventLog
from controller.run.state_machine import Event, Machine, State
from hal.notices import Level, Notice

RETRY_S: Final = (30.0, 60.0, 120.0, 300.0, 900.0)
"""Between attempts to leave FAULT."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Deadlines of the states, in seconds."""

    power_up_s: float = 1800.0
    cool_down_s: float = 900.0


@dataclass(frozen=True, slots=True)
class LightNeed:
    """``light``: lamps are wanted lit, for ``picture`` (something to play), for a ``job``, or for people alone."""

    light: bool
    picture: bool
    job: bool


class StageStates:
    """The stage's state machine. ``monotonic``: seconds that only go up, for deadlines.

    ``missing``: the projectors that gave no light when the stage last had to keep playing.
    """

    def __init__(self, log: EventLog, limits: Limits, monotonic: Callable[[], float]) -> None:
        self._log, self._limits, self._monotonic = log, limits, monotonic
        self.machine = Machine(self._changed)
        self.missing = frozenset[str]()
        self._since_s = monotonic()
        self._attempts, self._silent = 0, frozenset[str]()
        self._retry = False

    def follow(self, views: Sequence[ProjectorView], player: Notice | None, need: LightNeed) -> None:
        """Change to the next state if the devices or ``need`` ask for it. ``player``: the player's problem."""
        state = self.machine.state
        if state is State.OFF:
            if need.light:
                self.go(Event.START, "light is needed")
        elif state is State.COOLING:
            if need.light:
                self.machine.explain("It opens when the lamps have cooled.")
            self._cool(views)
        elif state is State.FAULT:
            self._recover(views, need.light)
        elif state is State.CALIBRATING:
            return
        elif not need.light:
            self.go(Event.STOP, "closed" if not need.picture else "nothing to do")
        elif state in (State.POWERING, State.WARMING):
            self._power(views, state)
        else:
            self._keep_playing(views, player, need)

    def _power(self, views: Sequence[ProjectorView], state: State) -> None:
        shining = [view for view in views if view.shines]
        coming = [view for view in views if view.coming]
        late = self._monotonic() - self._since_s > self._limits.power_up_s
        if (coming and not late) or not views:
            return
        if not shining:
            self.go(Event.FAIL, _reasons(views) or "No lamp gave light in time.")
        elif state is State.POWERING:
            self.go(Event.LAMPS_LIT, _reasons(views))
        elif late or all(view.stable_left_s <= 0 for view in shining if view.condition is Condition.LIT):
            self.go(Event.LAMPS_STABLE, _reasons(views))

    def _keep_playing(self, views: Sequence[ProjectorView], player: Notice | None, need: LightNeed) -> None:
        state = self.machine.state
        shining = [view.name for view in views if view.shines]
        reasons = _reasons(views)
        if player is not None:
            reasons = f"{player.what} {reasons}".strip()
        self.missing = frozenset(view.name for view in views if not view.shines)
        if not shining:
            coming = any(view.coming for view in views)
            self.go(Event.START if coming else Event.FAIL, reasons or "No lamp gives light.")
        elif state is State.DEGRADED:
            if not reasons and not self.missing:
                self.go(Event.RECOVERED, "every projector gives light again")
            else:
                self.machine.explain(reasons or _without_light(self.missing))
        elif reasons or self.missing:
            self.go(Event.DEGRADE, reasons or _without_light(self.missing))
        elif state is State.READY and need.picture and not need.job:
            self.go(Event.PLAY, "open")
        elif state is State.PLAYING and not need.picture:
            self.go(Event.PAUSE, "closed")

    def _cool(self, views: Sequence[ProjectorView]) -> None:
        lit = [view for view in views if view.condition is Condition.LIT or view.maybe_lit or not view.looked]
        if not lit:
            self.go(Event.COOLED, "every lamp is off or cooling by itself")
        elif self._monotonic() - self._since_s > self._limits.cool_down_s:
            names = ", ".join(view.name for view in lit)
            self.go(Event.FAIL, f"The lamp of {names} could not be switched off. Use its remote control.")

    def _recover(self, views: Sequence[ProjectorView], light: bool) -> None:
        if not light:
            # The lamps are wanted dark in this state, too: it ends when they are.
            if not any(view.condition is Condition.LIT or view.maybe_lit for view in views):
                self.go(Event.STOP, "closed")
        elif self._answers_again(views):
            self.go(Event.START, f"a projector answers again. Before: {self.machine.reason}")
        elif (
            self._retry
            or any(view.condition is Condition.LIT for view in views)
            or self._waited(RETRY_S[min(self._attempts, len(RETRY_S) - 1)])
        ):
            self._attempts += 1
            # Lamps take minutes, and until then people ask why it is dark.
            self.go(Event.START, f"trying again. Before: {self.machine.reason}")

    def _answers_again(self, views: Sequence[ProjectorView]) -> bool:
        """Whether one does that was silent in this fault: after a power cut, projectors boot longer than computers."""
        silent = frozenset(view.name for view in views if view.condition is Condition.LOST)
        back, self._silent = self._silent - silent, silent
        return bool(back)

    def _waited(self, seconds: float) -> bool:
        return self._monotonic() - self._since_s >= seconds

    def retry_now(self) -> None:
        """Leave FAULT at the next step, whatever is left of its waiting time. No other state has anything to retry."""
        self._retry = self.machine.state is State.FAULT

    def go(self, event: Event, reason: str) -> None:
        """Raises as ``Machine.handle``."""
        self._since_s, self._silent, self._retry = self._monotonic(), frozenset(), False
        self.machine.handle(event, reason)
        if event in (Event.PLAY, Event.COOLED):
            self._attempts = 0

    def _changed(self, change: object) -> None:
        machine = self.machine
        bad = machine.state in (State.FAULT, State.DEGRADED)
        remedy = "See the devices for what to do." if bad else ""
        text = f"The stage is {machine.state.value}" + (f": {machine.reason}" if machine.reason else "")
        level = Level.ERROR if machine.state is State.FAULT else Level.WARNING if bad else Level.INFO
        self._log.add(Notice("state", text.rstrip(".") + ".", remedy, level))


def _without_light(names: Collection[str]) -> str:
    return f"{', '.join(sorted(names))} gives no light."


def _reasons(views: Sequence[ProjectorView]) -> str:
    """What is wrong, the disk first; a remedy that several problems have is said once."""
    problems = [view.problem for view in views if view.problem is not None]
    by_remedy: dict[str, list[str]] = {}
    for problem in sorted(problems, key=lambda one: one.code != DISK_FULL):
        by_remedy.setdefault(problem.remedy, []).append(problem.what)
    return " ".join(" ".join([*dict.fromkeys(whats), remedy]).strip() for remedy, whats in by_remedy.items())
