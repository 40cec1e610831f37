"""The lamps' history as the panel shows it."""

from __future__ import annotations

from controller.kiosk.interface import EventRow, Lamp, LampDay
from controller.panel.pages.lamp_days import Burnt, stories

LEFT = Lamp("left", 1210.0, 90, True)


def test_each_day_has_what_was_burnt_on_it_and_a_new_lamp_is_no_negative_day() -> None:
    history = [
        LampDay("left", "2026-01-01", 1190.0, 84), LampDay("right", "2026-01-01", 5.0, 1),
        LampDay("left", "2026-01-02", 1197.5, 86), LampDay("left", "2026-01-04", 2.0, 1),
    ]  # fmt: skip
    (story,) = stories([LEFT], history, ())
    assert story.days == (Burnt("2026-01-04", 0.0, 0), Burnt("2026-01-02", 7.5, 2))


def test_a_lamp_that_is_new_to_velatura_has_its_first_day() -> None:
    (story,) = stories([Lamp("right", 5.0, 1, False)], [LampDay("right", "2026-01-01", 5.0, 1)], ())
    assert story.days == (Burnt("2026-01-01", 5.0, 1),)
    assert story.hours_a_strike == 5.0


def test_only_what_the_log_says_of_this_lamp_is_told() -> None:
    rows = [
        EventRow(1, 0.0, "info", "The lamp of projector left is struck.", "lamp-struck"),
        EventRow(2, 0.0, "info", "The lamp of projector right is struck.", "lamp-struck"),
        EventRow(3, 0.0, "info", "The player shows left marble.", "playing"),
    ]
    (story,) = stories([LEFT], (), rows)
    assert [row.number for row in story.events] == [1]


def test_a_lamp_is_told_nothing_of_one_whose_name_holds_its_own() -> None:
    names = ("left", "far left", "left.", "right, upper", ".*")
    rows = [
        EventRow(number, 0.0, "info", text, "lamp-struck")
        for number, text in enumerate((
            "The lamp of projector far left is struck.", "The lamp of left, far left could not be switched off.",
            "The lamp of projector left", "The lamp of projector right, upper is struck.", "Nothing on the leftmost.",
            "The lamp of projector .* is struck.",
        ))
    ]  # fmt: skip
    told = stories([Lamp(name, 1.0, 1, True) for name in names], (), rows)
    assert [[row.number for row in story.events] for story in told] == [[2, 1], [1, 0], [], [3], [5]]


def test_only_the_last_days_and_events_are_shown_newest_first() -> None:
    history = [LampDay("left", f"2026-01-{day:02d}", 5.0 * day, day) for day in range(1, 32)]
    rows = [EventRow(number, 0.0, "info", "The lamp of left is struck.", "lamp-struck") for number in range(40)]
    (story,) = stories([LEFT], history, rows)
    assert [day.day for day in story.days] == [f"2026-01-{day:02d}" for day in range(31, 10, -1)]
    assert {(day.hours, day.strikes) for day in story.days} == {(5.0, 1)}
    assert [row.number for row in story.events] == list(range(39, 27, -1))


def test_a_lamp_is_worn_by_strikes_that_were_many_and_short() -> None:
    def worn(hours: float, strikes: int) -> tuple[bool, float | None]:
        (story,) = stories([Lamp("left", hours, strikes, True)], (), ())
        return story.worn_by_strikes, story.hours_a_strike

    assert worn(0.0, 0) == (False, None)
    assert worn(9.0, 20) == (True, 0.45)
    assert worn(9.0, 19)[0] is False
    assert worn(10.0, 20)[0] is False
