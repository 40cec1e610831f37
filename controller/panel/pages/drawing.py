"""Renders HTML templates. All values are escaped, because text of devices, files and users is untrusted."""

from __future__ import annotations

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
            "percent": lambda share: f"{100 * share:.0f} %",
            "thousands": lambda number: f"{number:,.0f}",
            "ago": lambda unix_s: duration(time.time() - unix_s),
        }
        environment.globals["states"] = STATES
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
            "events": str(module.events(events[-EVENTS_SHOWN:][::-1])),
        }

    def _moment(self, unix_s: float) -> str:
        return self._local(unix_s, "%a %d %b %Y, %H:%M:%S")

    def _clock(self, unix_s: float) -> str:
        return self._local(unix_s, "%a %H:%M")

    def _local(self, unix_s: float, form: str) -> str:
        try:
            return datetime.fromtimestamp(unix_s, self._zone).strftime(form)
        except (ValueError, OverflowError, OSError):
            # A wrong time in a file must not break a page.
            return "at an unknown time"


def _source(name: str) -> str:
    return resources.files("controller.panel").joinpath("templates", name).read_text("utf-8")
