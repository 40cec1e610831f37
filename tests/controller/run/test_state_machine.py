"""The table is the truth; these tests say what must hold of it."""

from __future__ import annotations

import itertools
import threading

import pytest

from controller.core.errors import WorkError
from controller.run.state_machine import (
    TRANSITIONS,
    Change,
    Event,
    Machine,
    State,
    TransitionError,
    allowed_events,
    next_state,
)

PAIRS = list(itertools.product(State, Event))


@pytest.mark.parametrize(("state", "event"), PAIRS, ids=lambda value: value.name)
def test_every_pair_either_leads_somewhere_or_says_what_is_possible(state: State, event: Event) -> None:
    if (state, event) in TRANSITIONS:
        assert next_state(state, event) is TRANSITIONS[state, event]
        return
    with pytest.raises(TransitionError) as refused:
        next_state(state, event)
    assert refused.value.code == "state-not-allowed"
    assert all(repr(possible.value) in refused.value.remedy for possible in allowed_events(state))


def test_every_state_can_be_reached_from_off() -> None:
    reached = {State.OFF}
    while further := {after for (before, _), after in TRANSITIONS.items() if before in reached} - reached:
        reached |= further
    assert reached == set(State)


def test_off_is_reached_only_through_cooling() -> None:
    assert {before for (before, _), after in TRANSITIONS.items() if after is State.OFF} == {State.COOLING}


def test_a_stage_whose_lamps_may_be_lit_can_always_be_stopped() -> None:
    for state in set(State) - {State.OFF, State.COOLING}:
        assert next_state(state, Event.STOP) is State.COOLING


def test_cooling_can_not_be_left_for_a_new_strike() -> None:
    assert set(allowed_events(State.COOLING)) == {Event.COOLED, Event.FAIL}


def test_every_state_in_which_something_runs_can_fail() -> None:
    assert all(next_state(state, Event.FAIL) is State.FAULT for state in State if state not in (State.OFF, State.FAULT))


def test_light_is_needed_before_calibrating_or_playing() -> None:
    for after in (State.CALIBRATING, State.PLAYING):
        before = {state for (state, _), to in TRANSITIONS.items() if to is after}
        assert before <= {State.READY, State.PLAYING, State.DEGRADED}


def test_the_machine_keeps_the_reason_and_tells_listeners_in_order() -> None:
    told: list[Change] = []
    machine = Machine(told.append)
    machine.handle(Event.START, "morning")
    machine.handle(Event.FAIL, "Projector left reports lamp-failed.")
    assert machine.state is State.FAULT
    assert machine.reason == "Projector left reports lamp-failed."
    assert [(change.before, change.after) for change in told] == [
        (State.OFF, State.POWERING),
        (State.POWERING, State.FAULT),
    ]


def test_a_refused_event_changes_nothing_and_tells_nobody() -> None:
    told: list[Change] = []
    machine = Machine(told.append)
    assert not machine.allows(Event.PLAY)
    with pytest.raises(TransitionError):
        machine.handle(Event.PLAY)
    assert (machine.state, told) == (State.OFF, [])


def test_a_failing_listener_keeps_neither_the_state_nor_the_others_from_changing() -> None:
    told: list[Change] = []

    def full(change: Change) -> None:
        raise WorkError("no-space", what="Full.", remedy="Free some.")

    machine = Machine(full, told.append)
    with pytest.raises(WorkError, match="Full"):
        machine.handle(Event.START)
    assert machine.state is State.POWERING
    assert len(told) == 1


def test_threads_see_one_order_of_changes() -> None:
    told: list[Change] = []
    machine = Machine(told.append, state=State.READY)
    laps = [(Event.PLAY, Event.PAUSE), (Event.SOLVE, Event.SOLVED), (Event.PUBLISH, Event.PUBLISHED)]

    def work(there: Event, back: Event) -> None:
        for _ in range(200):
            try:
                machine.handle(there)
            except TransitionError:
                continue
            machine.handle(back)

    threads = [threading.Thread(target=work, args=lap) for lap in laps]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(first.after is second.before for first, second in itertools.pairwise(told))
