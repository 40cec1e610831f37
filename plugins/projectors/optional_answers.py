"""Optional queries that a projector does not answer, or not understandably: reported once, repeated seldom."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Final

from hal.notices import Notice

SILENT_S: Final = 60.0
"""Time before an unanswered optional query is repeated, because each costs seconds."""


class OptionalAnswers:
    """For one projector. ``name``: its name for the technician; ``fields``: the purpose of each query, for notes."""

    def __init__(self, name: str, fields: Mapping[str, str]) -> None:
        self._name = name
        self._fields = fields
        self._silent_until_s: dict[str, float] = {}
        self._unknown: set[str] = set()
        self._noted: set[str] = set()
        self._unreported: list[Notice] = []

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
