"""Renders HTML templates. All values are escaped, because text of devices, files and users is untrusted."""

from __future__ import annotations

import math
import time
import zoneinfo
from collections.abc import Mapping
from datetime import UTC, datetime, tzinfo
from importlib import resources
from typing import Any, Final

import jinja2

from controller.core.text import duration
from controller.kiosk.interface import EventRow, KioskState

STATES: Final = {
    "off": ("Closed", "quiet"),
    "powering": ("Switching on", "busy"),
    "warming": ("Warming up", "busy"),
    "ready": ("Ready", "good"),
    "calibrating": ("Calibrating", "busy"),
    "solving": ("Computing", "busy"),
    "publishing": ("Publishing", "busy"),
    "playing": ("Playing", "good"),
    "cooling": ("Cooling down", "busy"),
    "degraded": ("Playing with problems", "warn"),
    "fault": ("Fault", "bad"),
}
"""Label and style of each state."""

EVENTS_SHOWN: Final = 200
OPEN: Final = ("powering", "warming", "ready", "calibrating", "playing", "degraded")
CLOSED: Final = ("off", "cooling", "fault", "solving", "publishing")


def flags(state: KioskState) -> frozenset[str]:
    """What is true now; ``data-if`` of a control names those that it needs, with "!" those that it must not have."""
    busy = state.job is not None and not state.job.ended
    stops = busy and state.job is not None and state.job.cancellable
    found = {
        "open": state.state in OPEN, "closed": state.state in CLOSED, "busy": busy, "stops": stops,
        "set-up": not state.needs_setup, "calibrated": any(grade.kept for grade in state.grades),
        "playable": state.bundle is not None, "identifying": state.identifying, "in-turn": state.in_turn,
        "failed": bool(state.failures),
    }  # fmt: skip
    return frozenset(name for name, true in found.items() if true)


def holds(condition: str, now: frozenset[str]) -> bool:
    """Whether ``condition``, "open !busy", is true; as in the page's script."""
    return all((word[1:] not in now) if word.startswith("!") else word in now for word in condition.split())


def around(state: KioskState) -> list[dict[str, Any]]:
    """The projectors around the object, seen from above, for a drawing of 320 x 200 with the object in the middle.

    The camera is below. A projector without a known place is left out.
    """
    problems = {row.name for row in state.devices if row.problem is not None}
    lit = {lamp.projector for lamp in state.lamps if lamp.lit}
    drawn: list[dict[str, Any]] = []
    for place in state.places:
        angle = math.radians(place.aside_deg)
        # A wide picture: the sides are farther away than front and back.
        x, y = 160 + 125 * math.sin(angle), 84 + 66 * math.cos(angle)
        health = "bad" if place.projector in problems else "lit" if place.projector in lit else "dark"
        drawn.append(
            {"name": place.projector, "word": place.word, "x": round(x, 1), "y": round(y, 1), "health": health}
        )
    # Without the empty half where nobody stands behind the object.
    top = min([44.0, *(one["y"] - 30 for one in drawn)])
    return [one | {"top": round(top)} for one in drawn]


class Drawing:
    """The templates. Times are shown in the stage's time zone (``use_zone``)."""

    def __init__(self) -> None:
        self._zone: tzinfo = UTC
        environment = jinja2.Environment(
            loader=jinja2.FunctionLoader(_source),
            autoescape=True,
            undefined=jinja2.StrictUndefined,
            trim_blocks=True,
            lstrip_blocks=True,
        )
        environment.filters |= {
            "duration": duration,
            "moment": self._moment,
            "clock": self._clock,
            "exact": self._exact,
            "percent": lambda share: f"{100 * share:.0f} %",
            "thousands": lambda number: f"{number:,.0f}",
            "ago": lambda unix_s: duration(time.time() - unix_s),
        }
        environment.globals |= {"states": STATES, "flags": flags, "holds": holds, "around": around}
        self._environment = environment

    def use_zone(self, name: str) -> None:
        """Show times in this zone (IANA name); UTC if this machine does not know it."""
        try:
            self._zone = zoneinfo.ZoneInfo(name)
        except (zoneinfo.ZoneInfoNotFoundError, ValueError, OSError):
            self._zone = UTC

    def page(self, template: str, values: Mapping[str, Any]) -> str:
        return self._environment.get_template(template).render(values)

    def parts(self, state: KioskState, events: list[EventRow]) -> dict[str, str]:
        """The HTML of the live parts of all pages, by name."""
        module: Any = self._environment.get_template("parts.html").module
        return {
            "top": str(module.top(state)),
            "devices": str(module.devices(state)),
            "job": str(module.job(state)),
            "lamps": str(module.lamps(state)),
            "next": str(module.next(state)),
            "around": str(module.around_object(state)),
            "first": str(module.first_steps(state)),
            "events": str(module.events(events[-EVENTS_SHOWN:][::-1])),
        }

    def _moment(self, unix_s: float) -> str:
        return self._local(unix_s, "%a %d %b %Y, %H:%M")

    def _exact(self, unix_s: float) -> str:
        return self._local(unix_s, "%a %d %b %Y, %H:%M:%S")

    def _clock(self, unix_s: float) -> str:
        """With the weekday, unless it is today."""
        today = self._local(unix_s, "%x") == self._local(time.time(), "%x")
        return self._local(unix_s, "%H:%M" if today else "%a %H:%M")

    def _local(self, unix_s: float, form: str) -> str:
        try:
            return datetime.fromtimestamp(unix_s, self._zone).strftime(form)
        except (ValueError, OverflowError, OSError):
            # A wrong time in a file must not break a page.
            return "at an unknown time"


def _source(name: str) -> str:
    return resources.files("controller.panel").joinpath("templates", name).read_text("utf-8")
