"""What new opening hours do to a stage that is open now."""

from __future__ import annotations

from datetime import datetime

from controller.kiosk.decide.hours import openings, zone_of
from controller.kiosk.decide.operator_overrides import OperatorOverrides
from controller.kiosk.decide.planner import Plan, plan
from controller.kiosk.interface import Schedule


def effect(schedule: Schedule, overrides: OperatorOverrides, now: Plan, now_s: float) -> str:
    """That the hours close an open stage, in sentences; empty if they do not. ``now``: the plan in use.

    ``schedule`` must be checked. While the time is unknown (``now.open`` None), hours close nothing.
    """
    if now.open is None or not overrides.open(now):
        return ""
    if overrides.would_be_open(plan(now_s, schedule, (), since_s=now_s)):
        return ""
    zone = zone_of(schedule.time_zone)
    moment = datetime.fromtimestamp(now_s, zone)
    later = next((one.begins_s for one in openings(schedule, now_s) if one.begins_s > now_s), None)
    again = "" if later is None else f" It opens again on {datetime.fromtimestamp(later, zone):%A at %H:%M}."
    return (
        f"The stage closes at once, and its lamps cool down: it is {moment:%A, %H:%M} in {schedule.time_zone}, "
        f"outside these hours.{again}"
    )
