"""What a projector's answers mean where they say little.

``PowerView``: the power state of a projector that answers only "on" or "off". Several serial families report warming
and cooling by unsolicited lines, or not at all. This class keeps observations and their times to interpret a new
answer. A lamp that went off counts as hot until it reports standby or its cooling time is over; a lamp that came on
counts as warming for its warm-up time. If a family answers "warming" and "cooling" itself, its answers count. Pure: the
caller gives the time.

``OptionalAnswers``: optional queries that a projector does not answer, or not understandably, are reported once, and
repeated seldom.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Final

from hal.deadline import Deadline
from hal.notices import Notice
from hal.values import LampRules, Power


class PowerView:
    """Interprets power answers with the previous commands and notices. Times are seconds of one monotonic clock.

    ``tells``: the states in this family's power answers.
    """

    def __init__(self, rules: LampRules, tells: frozenset[Power] = frozenset()) -> None:
        self._rules = rules
        self._tells = tells
        self._last: Power | None = None
        self._phase: Power | None = None
        self._since_s = 0.0
        self._reported = False
        self._trouble: dict[str, None] = {}

    @property
    def trouble(self) -> tuple[str, ...]:
        """The projector's reports since it was last switched on, in order."""
        return tuple(self._trouble)

    @property
    def failed(self) -> bool:
        """Whether the projector reported something that stops it (any word but a warning)."""
        return any(not word.endswith("-warning") for word in self._trouble)

    def switched_on(self, now_s: float) -> None:
        """The projector accepted an on command; earlier reports no longer count."""
        self._trouble.clear()
        self._enter(Power.WARMING, now_s, reported=False)

    def switched_off(self, now_s: float) -> None:
        """The projector accepted an off command."""
        self._enter(Power.COOLING, now_s, reported=False)

    def noticed_power(self, power: Power, now_s: float) -> None:
        """The projector reported its power unasked."""
        if power in (Power.WARMING, Power.COOLING):
            self._enter(power, now_s, reported=True)
        else:
            self._phase = None
            self._last = power

    def noticed_trouble(self, word: str) -> None:
        self._trouble[word] = None

    def in_transition(self, now_s: float) -> bool:
        """Whether the lamp warms or cools, as far as is known."""
        return self._phase_at(now_s) is not None or self._last in (Power.WARMING, Power.COOLING)

    def reported(self, power: Power, now_s: float) -> bool:
        """Whether the projector itself reported ``power``, unasked."""
        return self._reported and self._phase_at(now_s) is power

    def answered(self, answer: Power, now_s: float) -> Power:
        """The power state, given a fresh ``answer``."""
        changed = self._last is not None and self._last is not answer
        self._last = answer
        if answer is Power.ON:
            return self._burns(changed, now_s)
        if answer is Power.OFF:
            return self._dark(changed, now_s)
        return answer

    def _burns(self, changed: bool, now_s: float) -> Power:
        if Power.WARMING in self._tells:
            self._phase = None
            return Power.ON
        phase = self._phase_at(now_s)
        if phase is Power.COOLING:
            # It is on again, or still: when it goes off, its cooling starts again.
            self._phase = None
        elif changed and phase is None:
            self._enter(Power.WARMING, now_s, reported=False)
        return Power.WARMING if self._phase is Power.WARMING else Power.ON

    def _dark(self, changed: bool, now_s: float) -> Power:
        if Power.COOLING in self._tells:
            self._phase = None if self._phase is Power.COOLING else self._phase
            return Power.FAULT if self.failed else Power.OFF
        if changed and self._phase_at(now_s) is not Power.COOLING:
            self._enter(Power.COOLING, now_s, reported=False)
        phase = self._phase_at(now_s)
        if phase is Power.COOLING or (phase is Power.WARMING and self._reported and not self.failed):
            return phase
        return Power.FAULT if self.failed else Power.OFF

    def _enter(self, phase: Power, now_s: float, *, reported: bool) -> None:
        self._phase, self._since_s, self._reported = phase, now_s, reported

    def _phase_at(self, now_s: float) -> Power | None:
        lasts_s = self._rules.warm_up_s if self._phase is Power.WARMING else self._rules.cool_down_s
        if self._phase is not None and now_s - self._since_s >= lasts_s:
            self._phase = None
        return self._phase


SILENT_S: Final = 60.0
"""Time before an unanswered optional query is repeated, because each costs seconds."""


COUNTER_S: Final = 3600.0
"""Counters such as lamp hours are asked again after this time, and when the power state has changed."""
UNCOUNTED_S: Final = 300.0
"""The same for one without an answer."""


class OptionalAnswers:
    """For one projector. ``name``: its name for the technician; ``fields``: the purpose of each query, for notes."""

    def __init__(self, name: str, fields: Mapping[str, str]) -> None:
        self._name = name
        self._fields = fields
        self._silent_until_s: dict[str, float] = {}
        self._unknown: set[str] = set()
        self._noted: set[str] = set()
        self._unreported: list[Notice] = []
        self._counters: dict[str, tuple[float, Power, int | None]] = {}

    def counted(
        self, question: str, power: Power, ask: Callable[[Deadline], int | None], deadline: Deadline
    ) -> int | None:
        """The value of a counter: as it was last answered, or asked now."""
        now_s = deadline.time.monotonic()
        asked_at_s, before, value = self._counters.get(question, (0.0, None, None))
        if before is not power or now_s - asked_at_s >= (UNCOUNTED_S if value is None else COUNTER_S):
            value = ask(deadline)
            self._counters[question] = now_s, power, value
        return value

    def may_ask(self, question: str) -> bool:
        """Whether to send an optional query now."""
        return time.monotonic() >= self._silent_until_s.get(question, 0.0)

    def silent(self, question: str, *, usual: bool = False) -> None:
        """An optional query was not answered; ``usual``: that is normal in this state and gets no note."""
        self._silent_until_s[question] = time.monotonic() + SILENT_S
        if not usual:
            self.odd(question, f"It does not answer the query {question}.")

    def odd(self, question: str, what: str) -> None:
        """The answer to an optional query was not understood; ``what``: a sentence that shows it."""
        if question not in self._noted:
            lead = f"The {self._fields.get(question, question)} of the projector at {self._name} stay unknown,"
            self._unreported.append(Notice.warning("projector-answer-odd", f"{lead} everything else works. {what}"))
        self._noted.add(question)
        self._unknown.add(question)

    def understood(self, question: str) -> None:
        self._unknown.discard(question)

    def knows(self, question: str) -> bool:
        """Whether the last answer to an optional query was understood."""
        return question not in self._unknown

    def notices(self) -> list[Notice]:
        """As ``hal.interfaces.WatchedProjector.notices``."""
        pending, self._unreported = self._unreported, []
        return pending
