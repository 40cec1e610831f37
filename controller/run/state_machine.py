"""The stage's state machine: an enum of states and a table of transitions. Work runs outside transitions."""

from __future__ import annotations

import enum
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from controller.core.errors import WorkError


class State(enum.Enum):
    """State of the stage."""

    OFF = "off"
    POWERING = "powering"
    WARMING = "warming"
    READY = "ready"
    CALIBRATING = "calibrating"
    SOLVING = "solving"
    PUBLISHING = "publishing"
    PLAYING = "playing"
    COOLING = "cooling"
    DEGRADED = "degraded"
    FAULT = "fault"


class Event(enum.Enum):
    """An event or a request."""

    START = "start"
    LAMPS_LIT = "lamps lit"
    LAMPS_STABLE = "lamps stable"
    RECALIBRATE = "recalibrate"
    CALIBRATED = "calibrated"
    SOLVE = "solve"
    SOLVED = "solved"
    PUBLISH = "publish"
    PUBLISHED = "published"
    PLAY = "play"
    PAUSE = "pause"
    CANCEL = "cancel"
    DEGRADE = "degrade"
    RECOVERED = "recovered"
    FAIL = "fail"
    STOP = "stop"
    COOLED = "cooled"


TRANSITIONS: Final[dict[tuple[State, Event], State]] = {
    (State.OFF, Event.START): State.POWERING,
    (State.POWERING, Event.LAMPS_LIT): State.WARMING,
    (State.WARMING, Event.LAMPS_STABLE): State.READY,
    (State.READY, Event.RECALIBRATE): State.CALIBRATING,
    (State.READY, Event.SOLVE): State.SOLVING,
    (State.READY, Event.PUBLISH): State.PUBLISHING,
    (State.READY, Event.PLAY): State.PLAYING,
    (State.CALIBRATING, Event.CALIBRATED): State.READY,
    (State.SOLVING, Event.SOLVED): State.READY,
    (State.PUBLISHING, Event.PUBLISHED): State.READY,
    (State.PLAYING, Event.PAUSE): State.READY,
    (State.PLAYING, Event.RECALIBRATE): State.CALIBRATING,
    # Work that is stopped on request leaves the lamps as they are; finished steps are in the journal.
    (State.CALIBRATING, Event.CANCEL): State.READY,
    (State.SOLVING, Event.CANCEL): State.READY,
    (State.PUBLISHING, Event.CANCEL): State.READY,
    # A stage with a failed device continues with the rest and reports it.
    (State.READY, Event.DEGRADE): State.DEGRADED,
    (State.CALIBRATING, Event.DEGRADE): State.DEGRADED,
    (State.PLAYING, Event.DEGRADE): State.DEGRADED,
    (State.DEGRADED, Event.RECOVERED): State.READY,
    (State.DEGRADED, Event.RECALIBRATE): State.CALIBRATING,
    # Every lamp is dark, and comes again.
    (State.READY, Event.START): State.POWERING,
    (State.PLAYING, Event.START): State.POWERING,
    (State.DEGRADED, Event.START): State.POWERING,
    # Stopping is allowed in every state with a lit lamp, and always leads to cooling.
    (State.POWERING, Event.STOP): State.COOLING,
    (State.WARMING, Event.STOP): State.COOLING,
    (State.READY, Event.STOP): State.COOLING,
    (State.CALIBRATING, Event.STOP): State.COOLING,
    (State.SOLVING, Event.STOP): State.COOLING,
    (State.PUBLISHING, Event.STOP): State.COOLING,
    (State.PLAYING, Event.STOP): State.COOLING,
    (State.DEGRADED, Event.STOP): State.COOLING,
    (State.FAULT, Event.STOP): State.COOLING,
    (State.COOLING, Event.COOLED): State.OFF,
    (State.POWERING, Event.FAIL): State.FAULT,
    (State.WARMING, Event.FAIL): State.FAULT,
    (State.READY, Event.FAIL): State.FAULT,
    (State.CALIBRATING, Event.FAIL): State.FAULT,
    (State.SOLVING, Event.FAIL): State.FAULT,
    (State.PUBLISHING, Event.FAIL): State.FAULT,
    (State.PLAYING, Event.FAIL): State.FAULT,
    (State.DEGRADED, Event.FAIL): State.FAULT,
    (State.COOLING, Event.FAIL): State.FAULT,
    # After a repair, lamps are checked again: a lit one is not struck, a hot one cools first.
    (State.FAULT, Event.START): State.POWERING,
}


class TransitionError(WorkError):
    """The event is not allowed in the present state."""


def next_state(state: State, event: Event) -> State:
    """The state after ``event``; pure. Raises TransitionError("state-not-allowed") for a pair not in the table."""
    try:
        return TRANSITIONS[state, event]
    except KeyError:
        allowed = ", ".join(repr(name.value) for name in allowed_events(state))
        raise TransitionError(
            "state-not-allowed",
            what=f"'{event.value}' is not possible while the stage is {state.value}.",
            remedy=f"Allowed now: {allowed}.",
        ) from None


def allowed_events(state: State) -> tuple[Event, ...]:
    """The events that ``state`` accepts, in the order of their definition."""
    return tuple(event for event in Event if (state, event) in TRANSITIONS)


@dataclass(frozen=True, slots=True)
class Change:
    """A transition. ``reason`` is a sentence for the technician, or empty."""

    before: State
    event: Event
    after: State
    reason: str


Listener = Callable[[Change], None]


class Machine:
    """The present state and its reason. Safe to use from several threads.

    Listeners are called after the state has changed, one change at a time and in order; the first is usually
    ``Journal.record_change``. If a listener fails, the others are still called, then its error is raised; the state
    stays changed.
    """

    def __init__(self, *listeners: Listener, state: State = State.OFF) -> None:
        self._lock = threading.RLock()
        self._state = state
        self._reason = ""
        self._listeners = list(listeners)

    @property
    def state(self) -> State:
        return self._state

    @property
    def reason(self) -> str:
        """Why the stage is in this state, as given with the last event or by ``explain``."""
        return self._reason

    def explain(self, reason: str) -> None:
        """The stage stays in its state, but for another reason by now. No listener is called."""
        self._reason = reason

    def listen(self, listener: Listener) -> None:
        """Call ``listener`` at every change from now on."""
        with self._lock:
            self._listeners.append(listener)

    def allows(self, event: Event) -> bool:
        return (self._state, event) in TRANSITIONS

    def handle(self, event: Event, reason: str = "") -> State:
        """Go to the next state and return it. Raises TransitionError and changes nothing if not allowed."""
        with self._lock:
            change = Change(self._state, event, next_state(self._state, event), reason)
            self._state, self._reason = change.after, reason
            failure: Exception | None = None
            for listener in tuple(self._listeners):
                try:
                    listener(change)
                except Exception as error:  # noqa: BLE001 - raised below, after all listeners were called
                    failure = failure or error
            if failure is not None:
                raise failure
            return change.after
