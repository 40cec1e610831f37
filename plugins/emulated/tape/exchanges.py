"""A recorded conversation as questions and answers, for programs that ask in their own order.

The next recorded answer to a question is given unless a command that changes the device comes before it in the record;
until that command is given, the previous answer is repeated. So a program that polls more often, or leaves questions
out, still sees the same device.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

Answer = TypeVar("Answer")


@dataclass(frozen=True, slots=True)
class Exchange(Generic[Answer]):
    question: Hashable
    answer: Answer


@dataclass(slots=True)
class Replay(Generic[Answer]):
    """The answers of one device. ``acts``: whether a question is a command that changes the device."""

    exchanges: Sequence[Exchange[Answer]]
    acts: Callable[[Hashable], bool]
    _at: int = 0

    def answer(self, question: Hashable) -> Answer | None:
        """The recorded answer that is due now; None for a question that was never recorded."""
        following = self._next(question)
        earlier = self._previous(question)
        if following is not None and (earlier is None or not self._left_out(following)):
            self._at = following + 1
            return self.exchanges[following].answer
        return None if earlier is None else self.exchanges[earlier].answer

    def _next(self, question: Hashable) -> int | None:
        numbers = range(self._at, len(self.exchanges))
        return next((number for number in numbers if self.exchanges[number].question == question), None)

    def _previous(self, question: Hashable) -> int | None:
        numbers = range(min(self._at, len(self.exchanges)) - 1, -1, -1)
        return next((number for number in numbers if self.exchanges[number].question == question), None)

    def _left_out(self, following: int) -> bool:
        """Whether a command before ``following`` must be given first."""
        return any(self.acts(exchange.question) for exchange in self.exchanges[self._at : following])
