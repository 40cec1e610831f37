"""The lamps' history as the panel shows it."""

from __future__ import annotations

from controller.kiosk.state import EventRow, Lamp
from controller.kiosk.values import LampDay
from controller.panel.pages.calendar import LampUse, lamp_reports

LEFT = Lamp("left", 1210.0, 90, True)


def test_each_day_has_what_was_burnt_on_it_and_a_new_lamp_is_no_negative_day() -> None:
    history = [
        LampDay("left", "2026-01-01", 1190.0, 84), LampDay("right", "2026-01-01", 5.0, 1),
        LampDay("left", "2026-01-02", 1197.5, 86), LampDay("left", "2026-01-04", 2.0, 1),
    ]  # fmt: skip
    (report,) = lamp_reports([LEFT], history, ())
    assert report.days == (LampUse("2026-01-04", 0.0, 0), LampUse("2026-01-02", 7.5, 2))


def test_a_lamp_that_is_new_to_velatura_has_its_first_day() -> None:
    (report,) = lamp_reports([Lamp("right", 5.0, 1, False)], [LampDay("right", "2026-01-01", 5.0, 1)], ())
    assert report.days == (LampUse("2026-01-01", 5.0, 1),)
    assert report.hours_a_strike == 5.0


def test_only_what_the_log_says_of_this_lamp_is_told() -> None:
    rows = [
        EventRow(1, 0.0, "info", "The lamp of projector left is being switched on.", "lamp-struck"),
        EventRow(2, 0.0, "info", "The lamp of projector right is being switched on.", "lamp-struck"),
        EventRow(3, 0.0, "info", "The player shows left marble.", "playing"),
    ]
    (report,) = lamp_reports([LEFT], (), rows)
    assert [row.number for row in report.events] == [1]


def test_a_lamp_is_told_nothing_of_one_whose_name_holds_its_own() -> None:
    names = ("left", "far left", "left.", "right, upper", ".*")
    rows = [
        EventRow(number, 0.0, "info", text, "lamp-struck")
        for number, text in enumerate((
            "The lamp of projector far left is being switched on.",
            "The lamp of left, far left could not be switched off.",
            "The lamp of projector left", "The lamp of projector right, upper is being switched on.",
            "Nothing on the leftmost.",
            "The lamp of projector .* is being switched on.",
        ))
    ]  # fmt: skip
    told = lamp_reports([Lamp(name, 1.0, 1, True) for name in names], (), rows)
    assert [[row.number for row in report.events] for report in told] == [[2, 1], [1, 0], [], [3], [5]]


def test_only_the_last_days_and_events_are_shown_newest_first() -> None:
    history = [LampDay("left", f"2026-01-{day:02d}", 5.0 * day, day) for day in range(1, 32)]
    text = "The lamp of left is being switched on."
    rows = [EventRow(number, 0.0, "info", text, "lamp-struck") for number in range(40)]
    (report,) = lamp_reports([LEFT], history, rows)
    assert [day.day for day in report.days] == [f"2026-01-{day:02d}" for day in range(31, 10, -1)]
    assert {(day.hours, day.strikes) for day in report.days} == {(5.0, 1)}
    assert [row.number for row in report.events] == list(range(39, 27, -1))


def test_a_lamp_is_worn_by_strikes_that_were_many_and_short() -> None:
    def worn(hours: float, strikes: int) -> tuple[bool, float | None]:
        (report,) = lamp_reports([Lamp("left", hours, strikes, True)], (), ())
        return report.worn_by_strikes, report.hours_a_strike

    assert worn(0.0, 0) == (False, None)
    assert worn(9.0, 20) == (True, 0.45)
    assert worn(9.0, 19)[0] is False
    assert worn(10.0, 20)[0] is False
