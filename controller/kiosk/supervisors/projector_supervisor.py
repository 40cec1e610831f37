"""Keeps one projector lit or dark as wanted: reads its status, compares, and does the next step, again and again."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

from controller.core.errors import VelaturaError
from controller.kiosk.decide.interfaces import DISK_FULL, Condition, ProjectorView
from controller.kiosk.supervisors.device_supervisor import pause_s
from controller.optics.capture.acquire import DISK_CODES
from controller.stage.rig.lamp_guard import LampGuard, fatal_faults, faulty
from controller.stage.rig.lamp_ledger import Clock, SystemClock
from hal.deadline import Deadline, in_seconds
from hal.errors import CodedError, DeviceError, DeviceRefused
from hal.notices import Level, Notice
from hal.values import Power, ProjectorStatus

ANSWER_S: Final = 5.0
PATIENCE_S: Final = 15.0
"""A projector counts as lost when it has been silent for this long."""
MOST_STRIKES: Final = 3
"""Failed attempts to light the lamp in a row, after which it stays off until the next opening."""
LINE_WELL_S: Final = 60.0
"""A line that answered for so long is well: a last attempt that had no answer is made again."""
REOPEN_AFTER_FAULT_S: Final = 120.0
"""A projector that reported a fault is reopened after this time: many report a fault, but never its end."""
LIGHT_MARGIN_S: Final = 30.0
LONGEST_WARM_UP_S: Final = 900.0
"""A projector that says itself that it warms up has so long: switched off in its warm-up, a lamp suffers."""
_LOOKS: Final = {
    Power.ON: Condition.LIT, Power.WARMING: Condition.LIGHTING, Power.COOLING: Condition.COOLING,
    Power.OFF: Condition.DARK,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Pace:
    """Seconds between two questions to a projector that is lit, or dark, as wanted. While a change is expected, every
    step asks: the control boards of some hang when they are asked often for long.
    """

    lit_s: float = 15.0
    dark_s: float = 18.0


@dataclass(frozen=True, slots=True)
class Mains:
    """The mains of a projector. ``asleep``: whether it has none now, or is booting, so that its silence means nothing;
    ``problem``: that of the relays that supply it, which may be the reason for its silence.
    """

    asleep: Callable[[], bool] = lambda: False
    problem: Callable[[], Notice | None] = lambda: None


@dataclass(frozen=True, slots=True)
class LampBefore:
    """A lamp before this service began. ``maybe_lit``: it may be lit; ``failed``: attempts in a row that gave no light.

    ``keep_forgiven`` keeps over a restart that at most so many attempts count, even while the line is broken.
    """

    maybe_lit: bool = False
    failed: int = 0
    keep_forgiven: Callable[[int], None] = lambda most: None


class ProjectorSupervisor:
    """One projector. One thread calls ``step`` repeatedly; any thread may use the rest.

    Parameters
    ----------
    open_guard : opens the projector; raises DeviceError or VelaturaError if that fails
    tell : receives what people should know
    deadline : one that ends in so many seconds
    """

    def __init__(
        self,
        name: str,
        open_guard: Callable[[Deadline], LampGuard],
        tell: Callable[[Notice], object],
        *,
        clock: Clock | None = None,
        mains: Mains | None = None,
        lamp: LampBefore | None = None,
        deadline: Callable[[float], Deadline] = in_seconds,
    ) -> None:
        lamp = lamp or LampBefore()
        self.name = name
        self._open_guard, self._tell = open_guard, tell
        self._clock = clock or SystemClock()
        self._mains = mains or Mains()
        self._deadline, self._keep_forgiven = deadline, lamp.keep_forgiven
        self._guard: LampGuard | None = None
        self._want_lit: bool | None = None
        self._view = ProjectorView(name, maybe_lit=lamp.maybe_lit)
        self._stepping = self._closed = False
        self._silent_since_s: float | None = None
        self._reopen_at_s = 0.0
        self._struck_at_s: float | None = None
        """Since when its light is awaited: the attempt, then the first answer that it warms up."""
        self._warms = False
        self._failed_strikes = lamp.failed
        self._unanswered = False
        """Whether the last attempt had neither an answer nor an effect: the projector may never have received it."""
        self._answers_since_s: float | None = None
        self._burning = False
        self._faulty_since_s: float | None = None
        self.pace = Pace()
        self._answered_at_s = float("-inf")
        """When it last answered; long ago if it is to be asked at once."""
        self._phase: tuple[Power, float] | None = None
        """What it says it does, warming or cooling, and since when; infinitely late once that was reported."""

    @property
    def view(self) -> ProjectorView:
        return self._view

    @property
    def guard(self) -> LampGuard | None:
        """The opened projector, for jobs; None while it is not open."""
        return self._guard

    @property
    def may_light(self) -> bool:
        """Whether the lamp may be lit, or the step that is running now may light it."""
        # In this order: a step updates the view before it ends.
        return self._stepping or self._view.maybe_lit

    @property
    def want_lit(self) -> bool | None:
        """None until it is set: until then a lamp stays as it is when the service starts."""
        return self._want_lit

    @want_lit.setter
    def want_lit(self, wanted: bool | None) -> None:
        if wanted and self._want_lit is False:
            # A lamp that stays off after failed attempts gets one more attempt at every opening, and for work on a dark
            # stage. A service that begins while the stage is open is no opening.
            self._failed_strikes = min(self._failed_strikes, MOST_STRIKES - 1)
            self._keep_forgiven(MOST_STRIKES - 1)
        if wanted and not self._want_lit:
            self._faulty_since_s, self._unanswered = float("-inf"), False
        if wanted is not self._want_lit:
            self._answered_at_s = float("-inf")
        self._want_lit = wanted

    def forgive(self) -> None:
        """After the technician's repair: allow all attempts again, the first at once."""
        self._failed_strikes, self._faulty_since_s, self._unanswered = 0, float("-inf"), False
        self._answered_at_s = float("-inf")
        self._keep_forgiven(0)

    def step(self) -> None:
        """Read the status if it is time to, and act on it. It blocks for a few answers; raises no device errors."""
        self._stepping = True
        try:
            self._step()
        finally:
            self._stepping = False

    def _step(self) -> None:
        if self._mains.asleep():
            self._silent_since_s = None
            self._reopen_at_s, self._answered_at_s = 0.0, float("-inf")
            self._show(ProjectorView(self.name, Condition.DARK, Power.OFF, looked=True, hours=self._view.hours,
                                     strikes=self._view.strikes, counter_hours=self._view.counter_hours))  # fmt: skip
            return
        try:
            guard = self._opened()
            if guard is None:
                return
            if self._clock.now_s() - self._answered_at_s < self._pause_s(guard):
                self._show(replace(self._view, stable_left_s=guard.stable_left_s()))
                return
            # Before the question: what is wanted may change while it is answered.
            self._answered_at_s = self._clock.now_s()
            status = guard.status(deadline=self._deadline(ANSWER_S))
            for notice in guard.notices():
                self._tell(Notice(notice.code, notice.text, "", Level.WARNING))
        except CodedError as error:
            self._silent(error)
            return
        self._silent_since_s = None
        self._watch_phase(guard, status.power)
        if self._answers_since_s is None:
            self._answers_since_s = self._clock.now_s()
        # Read late: opening the line takes seconds, and the lamp may not be wanted any more.
        wanted = self._want_lit
        try:
            if wanted is None:
                self._see(_LOOKS.get(status.power, Condition.BROKEN), status, None)
            elif wanted:
                self._light(guard, status)
            else:
                self._darken(guard, status)
        except CodedError as error:
            self._answers_since_s = None
            self._see(self._view.condition, status, Notice.of(error, level=Level.ERROR))
        self._keep_failed(guard)

    def _pause_s(self, guard: LampGuard) -> float:
        """Seconds from the last answer to the next question; 0 while a change is expected."""
        wanted, view = self._want_lit, self._view
        if self._silent_since_s is not None or view.condition in (Condition.LIGHTING, Condition.COOLING):
            return 0.0
        if view.condition is Condition.LIT and wanted is not False:
            return self.pace.lit_s
        if view.condition is Condition.DARK and not wanted:
            return self.pace.dark_s
        # A fault, or a lamp that is given up. One that may burn is switched off until it does not.
        full = view.problem is not None and view.problem.code == DISK_FULL
        broken = view.condition is Condition.BROKEN and not full
        return self.pace.lit_s if broken and (wanted or not guard.may_be_lit) else 0.0

    def _watch_phase(self, guard: LampGuard, power: Power) -> None:
        """Tell once if the projector says for longer than its profile that it warms up or cools."""
        now_s = self._clock.now_s()
        if power not in (Power.WARMING, Power.COOLING):
            self._phase = None
        elif self._phase is None or self._phase[0] is not power:
            self._phase = power, now_s
        else:
            cools = power is Power.COOLING
            rules = guard.capabilities.lamp_rules
            limit_s = 2 * rules.cool_down_s + LIGHT_MARGIN_S if cools else self._light_limit_s(guard)
            if now_s - self._phase[1] > limit_s:
                self._phase = power, float("inf")
                does = "cooled" if cools else "warmed up"
                self._tell(Notice(
                    f"lamp-{'cools' if cools else 'warms'}-long",
                    f"Projector {self.name} has {does} for {limit_s:.0f} s, longer than its profile expects.",
                    "Wait for it. If it always takes so long, give the time under [safety] in stage.toml.",
                    Level.WARNING,
                ))  # fmt: skip

    def _keep_failed(self, guard: LampGuard) -> None:
        guard.keep_failed(self._failed_strikes + (self._struck_at_s is not None))

    def close(self) -> None:
        """Close the line for good; the lamp stays as it is."""
        self._closed = True
        if self._guard is not None:
            self._release(self._guard)

    # -- the line

    def _opened(self) -> LampGuard | None:
        if self._guard is None:
            if self._clock.now_s() < self._reopen_at_s:
                return None
            self._answered_at_s = float("-inf")
            self._guard = self._open_guard(self._deadline(ANSWER_S))
            if self._closed:
                # Closed while it was being opened: release the line, because the next service needs it.
                self._release(self._guard)
                self._guard = None
        return self._guard

    def _release(self, guard: LampGuard) -> None:
        try:
            guard.close()
        except DeviceError as error:
            self._tell(replace(Notice.of(error, level=Level.ERROR), level=Level.WARNING))

    def _silent(self, error: CodedError) -> None:
        now_s = self._clock.now_s()
        self._answers_since_s = None
        if self._silent_since_s is None:
            self._silent_since_s = now_s
        guard = self._guard
        if guard is not None:
            # Attempts may be allowed again while it is silent. With its own count, its next record would undo that.
            self._keep_failed(guard)
        if guard is not None and self._want_lit is False and guard.may_be_lit:
            # It may receive the command, even if it does not answer.
            with contextlib.suppress(DeviceError, VelaturaError):
                guard.switch_off(deadline=self._deadline(guard.switch_s))
        limit_s = PATIENCE_S
        if guard is not None and self._struck_at_s is not None:
            # Many do not answer while they boot.
            limit_s = max(limit_s, self._struck_at_s + self._light_limit_s(guard) - self._silent_since_s)
        if guard is None or now_s - self._silent_since_s >= limit_s:
            self._lost(error)

    def _lost(self, error: CodedError) -> None:
        maybe_lit = self._guard.may_be_lit if self._guard is not None else self._view.maybe_lit
        if self._guard is not None:
            self._release(self._guard)
            self._guard = None
        assert self._silent_since_s is not None
        now_s = self._clock.now_s()
        self._reopen_at_s = now_s + pause_s(now_s - self._silent_since_s)
        self._struck_at_s = None
        problem, unfed = Notice.of(error, level=Level.ERROR), self._mains.problem()
        if unfed is not None:
            problem = replace(problem, what=f"{problem.what} {unfed.what}", remedy=unfed.remedy)
        self._show(replace(self._view, condition=Condition.LOST, power=Power.UNKNOWN, maybe_lit=maybe_lit, looked=True,
                           problem=problem))  # fmt: skip

    # -- lit

    def _light(self, guard: LampGuard, status: ProjectorStatus) -> None:
        if status.power in (Power.ON, Power.WARMING, Power.COOLING):
            # It received the command, whatever became of its answer.
            self._unanswered = False
        if status.power is Power.FAULT or fatal_faults(status):
            if status.power in (Power.ON, Power.WARMING):
                guard.switch_off(deadline=self._deadline(guard.switch_s))
            self._struck_at_s = None
            self._see(Condition.BROKEN, status, Notice.of(faulty(self.name, status), level=Level.ERROR))
            self._reopen_after_fault(guard)
        elif status.power is Power.ON or not guard.capabilities.power:
            self._struck_at_s, self._burning, self._faulty_since_s = None, True, None
            if guard.stable_left_s() <= 0:
                self._failed_strikes = 0
            self._see(Condition.LIT, status, None)
        elif status.power is Power.WARMING:
            self._await_light(guard, status)
        elif status.power is Power.COOLING:
            self._went_dark(status)
            self._see(Condition.COOLING, status, self._view.problem)
        else:
            self._strike(guard, status)

    def _reopen_after_fault(self, guard: LampGuard) -> None:
        now_s = self._clock.now_s()
        if self._faulty_since_s is None:
            self._faulty_since_s = now_s
        if self._failed_strikes >= MOST_STRIKES or now_s - self._faulty_since_s < REOPEN_AFTER_FAULT_S:
            return
        self._failed_strikes, self._faulty_since_s, self._burning = self._failed_strikes + 1, now_s, False
        guard.close()
        self._guard = None

    def _await_light(self, guard: LampGuard, status: ProjectorStatus) -> None:
        if self._struck_at_s is None or not self._warms:
            # A command may arrive late, and a lamp is not switched off in the middle of its warm-up.
            self._struck_at_s, self._warms = self._clock.now_s(), True
        if self._clock.now_s() - self._struck_at_s > max(LONGEST_WARM_UP_S, self._light_limit_s(guard)):
            self._strike_failed()
            guard.switch_off(deadline=self._deadline(guard.switch_s))
        self._see(Condition.LIGHTING, status, self._awaited)

    @property
    def _awaited(self) -> Notice | None:
        """The problem of a lamp that was switched on: what prevented it is over, what was wrong with it perhaps not."""
        problem = self._view.problem
        return None if problem is not None and problem.code == DISK_FULL else problem

    def _strike(self, guard: LampGuard, status: ProjectorStatus) -> None:
        self._went_dark(status)
        now_s = self._clock.now_s()
        if self._struck_at_s is not None:
            if now_s - self._struck_at_s <= self._light_limit_s(guard):
                return self._see(Condition.LIGHTING, status, self._awaited)
            self._strike_failed()
        if self._failed_strikes >= MOST_STRIKES and not self._one_more():
            return self._see(Condition.BROKEN, status, _unlit(self.name))
        strikes = guard.use().strikes
        try:
            guard.switch_on(deadline=self._deadline(guard.switch_s), failed=self._failed_strikes + 1)
        except DeviceRefused as error:
            if error.code in ("lamp-cooling", "lamp-resting"):
                return self._see(Condition.COOLING, status, self._view.problem)
            return self._see(Condition.BROKEN, status, Notice.of(error, level=Level.ERROR))
        except DeviceError:
            # The projector may have received the command: without its answer, too, this is an attempt.
            if guard.use().strikes > strikes:
                self._struck_at_s, self._warms, self._unanswered = now_s, False, True
            raise
        except VelaturaError as error:
            # The lamp counter can't be saved, so the lamp was not switched on.
            return self._see(Condition.BROKEN, status, _unrecorded(error))
        self._struck_at_s, self._warms, self._unanswered = now_s, False, False
        self._tell(Notice("lamp-struck", f"The lamp of projector {self.name} is being switched on."))
        return self._see(Condition.LIGHTING, status, self._awaited)

    def _one_more(self) -> bool:
        """Whether the last attempt is made again: the projector seems not to have received it, and its line is well."""
        well_s = 0.0 if self._answers_since_s is None else self._clock.now_s() - self._answers_since_s
        return self._unanswered and self._failed_strikes == MOST_STRIKES and well_s >= LINE_WELL_S

    def _went_dark(self, status: ProjectorStatus) -> None:
        if self._burning:
            self._burning = False
            self._failed_strikes += 1
            self._tell(Notice(
                "lamp-went-off", f"The lamp of projector {self.name} went off by itself (power: {status.power.value}).",
                "It is switched on again when it has cooled. If this happens again, replace the lamp.", Level.WARNING,
            ))  # fmt: skip

    def _strike_failed(self) -> None:
        self._struck_at_s = None
        self._failed_strikes += 1
        retried = self._failed_strikes < MOST_STRIKES
        self._tell(Notice(
            "lamp-not-lit", f"The lamp of projector {self.name} was switched on, but gave no light.",
            "It is tried again after its minimum off time." if retried else "It stays off now.", Level.WARNING,
        ))  # fmt: skip

    def _light_limit_s(self, guard: LampGuard) -> float:
        return 2 * guard.capabilities.lamp_rules.warm_up_s + LIGHT_MARGIN_S

    # -- dark

    def _darken(self, guard: LampGuard, status: ProjectorStatus) -> None:
        self._struck_at_s, self._burning = None, False
        faults = status.power is Power.FAULT or bool(fatal_faults(status))
        problem = Notice.of(faulty(self.name, status), level=Level.ERROR) if faults else None
        if not guard.capabilities.power:
            self._see(Condition.DARK, status, None)
        elif status.power in (Power.OFF, Power.COOLING):
            resting = status.power is Power.COOLING or guard.rest_left_s() > 0
            self._see(Condition.COOLING if resting else Condition.DARK, status, problem)
        else:
            # Until the next status shows it off: the lamp may be lit behind FAULT and UNKNOWN. What prevented the last
            # attempt stays a problem so long; otherwise every second would have two events.
            condition = Condition.BROKEN if faults else Condition.LIT
            kept = self._view.problem if self._view.condition is condition else None
            self._see(condition, status, problem if kept is None or _same_code(kept, problem) else kept)
            if not (faults and status.power is Power.FAULT and not guard.may_be_lit):
                guard.switch_off(deadline=self._deadline(guard.switch_s))

    # -- the view

    def _see(self, condition: Condition, status: ProjectorStatus, problem: Notice | None) -> None:
        guard = self._guard
        assert guard is not None
        use = guard.use()
        self._show(ProjectorView(
            self.name, condition, status.power, guard.stable_left_s(), guard.may_be_lit, use.hours, use.strikes,
            status.lamp_hours, True, problem,
        ))  # fmt: skip

    def _show(self, view: ProjectorView) -> None:
        before, self._view = self._view, view
        code_before = before.problem.code if before.problem else ""
        if view.problem is not None and view.problem.code != code_before:
            self._tell(replace(view.problem, level=Level.ERROR))
        elif view.problem is None and before.problem is not None and code_before != DISK_FULL:
            # The disk itself says when it has room again.
            self._tell(Notice("projector-back", f"Projector {self.name} works again ({view.condition.value})."))


def _same_code(one: Notice, other: Notice | None) -> bool:
    return other is not None and one.code == other.code


def _unrecorded(error: VelaturaError) -> Notice:
    """The same for all projectors, because it is one problem, of the disk."""
    if error.code not in DISK_CODES:
        return Notice.of(error, level=Level.ERROR)
    reason = "No lamp is switched on, because the disk of the stage is full or can't be written to."
    return Notice(DISK_FULL, reason, "Free some space on the disk, and check that it is in order.", Level.ERROR)


def _unlit(name: str) -> Notice:
    return Notice(
        "lamp-given-up",
        f"The lamp of projector {name} gave no light in {MOST_STRIKES} attempts and stays off.",
        "Replace the lamp, then press Open. Otherwise it is tried once more at the next opening or work.",
        Level.ERROR,
    )
