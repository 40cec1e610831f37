"""The verbs that a building may use, in one place: each protocol turns its messages into these and nothing else."""

from __future__ import annotations

import json
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from controller.core.errors import UsageError, WorkError
from controller.kiosk.interface import Kiosk
from controller.kiosk.operations.fields import Field, Values, parse
from controller.kiosk.operations.operation import Operation
from controller.kiosk.operations.table import OPERATIONS
from controller.kiosk.roles import Role
from controller.kiosk.state import KioskState

MOST_SOURCES: Final = 256


@dataclass(frozen=True, slots=True)
class Rate:
    """At most ``burst`` verbs at once, and ``per_s`` a second from then on, from each source."""

    burst: int = 20
    per_s: float = 10.0


class Rates:
    """What each source has used of a rate; thread-safe."""

    def __init__(self, rate: Rate, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._rate, self._clock = rate, clock
        self._used: OrderedDict[str, tuple[float, float]] = OrderedDict()
        self._lock = threading.Lock()

    def take(self, source: str) -> None:
        """Count one verb of a source, such as an address. Raises WorkError("too-many-verbs")."""
        with self._lock:
            now = self._clock()
            level, then = self._used.get(source, (0.0, now))
            level = max(0.0, level - (now - then) * self._rate.per_s)
            if level > self._rate.burst - 1:
                raise WorkError(
                    "too-many-verbs", what="Too many requests came from this source.", remedy="Send them more slowly."
                )
            self._used[source] = (level + 1, now)
            self._used.move_to_end(source)
            while len(self._used) > MOST_SOURCES:
                self._used.popitem(last=False)


class Verbs:
    """What one protocol may do. ``who`` stands in the event log; ``role`` limits it; thread-safe.

    The verbs are the operations that change what the stage shows and nothing that is kept (``building_verb``): open,
    close, play, rotate, next, black, pause, brightness, identify. They may take a moment: call them in a thread.
    """

    def __init__(
        self, kiosk: Kiosk, who: str, *, role: Role = Role.OPERATOR, rate: Rate | None = None,
        operations: Sequence[Operation] = OPERATIONS, clock: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        self._kiosk, self._who, self._role = kiosk, who, role
        self._rates = Rates(rate or Rate(), clock=clock)
        self._table = {operation.building_verb: operation for operation in operations if operation.building_verb}

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self._table)

    def status(self) -> KioskState:
        """From memory, at once; every role may ask."""
        return self._kiosk.snapshot()

    def appearances(self) -> tuple[str, ...]:
        """The names of the installed appearances, in the bundle's order. Raises as the kiosk's."""
        return tuple(one.name for one in self._kiosk.appearances())

    def fields(self, verb: str) -> tuple[Field, ...]:
        """The values that a verb takes. Raises UsageError("verb-unknown")."""
        return self._operation(verb).fields

    def values(self, verb: str, sent: Mapping[str, Any] | str | bytes) -> Values:
        """Checked values of ``verb``: from an object, or from text that is its first value or a JSON object.

        Raises UsageError("verb-unknown"), and as ``fields.parse``.
        """
        fields = self._operation(verb).fields
        if not isinstance(sent, str | bytes):
            return parse(fields, sent, strings=False)
        text = sent.decode("utf-8", "replace") if isinstance(sent, bytes) else sent
        required = [field for field in fields if field.required]
        if len(required) > 1 or text.lstrip().startswith("{"):
            return parse(fields, _object(text), strings=False)
        named = (required or fields)[:1]
        return parse(named, {field.name: text for field in named}, strings=True)

    def time_zone(self) -> str:
        """The stage's time zone, an IANA name."""
        return self._kiosk.schedule().time_zone

    def record(self, code: str, what: str) -> None:
        """Add a problem to the event log."""
        self._kiosk.record(code, f"{self._who}: {what}", "error")

    def do(self, verb: str, sent: Mapping[str, Any] | str | bytes = "", *, source: str = "") -> None:
        """Do it for ``source``, such as an address.

        Raises UsageError("verb-unknown", "verb-not-allowed"), WorkError("too-many-verbs"), and what the kiosk raises.
        """
        operation = self._operation(verb)
        if operation.role > self._role:
            raise UsageError(
                "verb-not-allowed", what=f"{self._who} may only look.",
                remedy='Set role = "operator" for it in building.toml.',
            )  # fmt: skip
        values = self.values(verb, sent)
        self._rates.take(source)
        named = f"{self._who} ({source})" if source else self._who
        with operation.logged(self._kiosk.record, named, values):
            operation.function(self._kiosk, **values)

    def subscribe(self, callback: Callable[[], None]) -> Callable[[], None]:
        """Call ``callback`` (quick, from any thread) after every change of the state; returns what ends that."""
        return self._kiosk.subscribe(callback)

    def _operation(self, verb: str) -> Operation:
        operation = self._table.get(verb)
        if operation is None:
            raise UsageError(
                "verb-unknown", what="There is no such verb.", remedy=f"Use one of {', '.join(self._table)}."
            )
        return operation


def _object(text: str) -> Mapping[str, Any]:
    try:
        sent = json.loads(text)
    except (ValueError, RecursionError):
        sent = None
    if not isinstance(sent, Mapping):
        raise UsageError("body-wrong", what="The payload is not a JSON object.", remedy="Send one object of fields.")
    return sent
