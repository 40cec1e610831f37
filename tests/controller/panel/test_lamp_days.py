"""The lamps' history as the panel shows it."""

from __future__ import annotations

from controller.panel.kiosk import EventRow, Lamp, LampDay
from controller.panel.lamp_days import Burnt, stories

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
