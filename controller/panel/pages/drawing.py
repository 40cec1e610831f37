"""Renders HTML templates in the visitor's language. All values are escaped, because text of devices, files and users
is untrusted."""

from __future__ import annotations

import math
import time
import zoneinfo
from collections.abc import Callable, Mapping
from datetime import UTC, date, datetime, tzinfo
from importlib import resources
from typing import Any, Final

import jinja2

from controller.core.text import duration
from controller.kiosk.state import EventRow, KioskState, troubles
from controller.panel.pages import curves
from controller.panel.words import days, figures, spoken
from controller.panel.words.language import LANGUAGES, gettext, language, look, mark, ngettext

STATES: Final = {
    "off": (mark("Closed"), "quiet"),
    "powering": (mark("Switching on"), "busy"),
    "warming": (mark("Warming up"), "busy"),
    "ready": (mark("Ready"), "good"),
    "calibrating": (mark("Calibrating"), "busy"),
    "solving": (mark("Computing"), "busy"),
    "publishing": (mark("Publishing"), "busy"),
    "playing": (mark("Playing"), "good"),
    "cooling": (mark("Cooling down"), "busy"),
    "degraded": (mark("Playing with problems"), "warn"),
    "fault": (mark("Fault"), "bad"),
}
"""Label and style of each state."""
NOTHING_YET: Final = mark("Nothing to show yet")
NOTHING_PLAYS: Final = mark("Nothing plays")
UNKNOWN: Final = mark("Nothing is known yet")
UNKNOWN_TIME: Final = mark("at an unknown time")

EVENTS_SHOWN: Final = 200
OPEN: Final = ("powering", "warming", "ready", "calibrating", "playing", "degraded")
PLAYS: Final = ("playing", "degraded")
CLOSED: Final = ("off", "cooling", "fault", "solving", "publishing")


def flags(state: KioskState) -> frozenset[str]:
    """What is true now; ``data-if`` of a control names those that it needs, with "!" those that it must not have."""
    runs = state.job is not None and not state.job.ended
    busy = runs and state.job is not None and not state.job.background
    stops = runs and state.job is not None and state.job.cancellable
    found = {
        "open": state.state in OPEN, "closed": state.state in CLOSED, "busy": busy, "stops": stops,
        "set-up": not state.needs_setup, "calibrated": any(grade.kept for grade in state.grades),
        "playable": state.bundle is not None, "identifying": state.identifying, "in-turn": state.in_turn,
        "failed": bool(state.failures), "plays": state.state in PLAYS and (bool(state.playing) or state.black),
        "black": state.black, "paused": state.paused,
        "made": bool(state.made) and state.made != state.playing,
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
    lives = {lamp.projector: lamp.hours / lamp.life_hours for lamp in state.lamps if lamp.life_hours}
    drawn: list[dict[str, Any]] = []
    for place in state.places:
        angle = math.radians(place.aside_deg)
        # A wide picture: the sides are farther away than front and back.
        x, y = 160 + 125 * math.sin(angle), 84 + 66 * math.cos(angle)
        health = "bad" if place.projector in problems else "lit" if place.projector in lit else "dark"
        drawn.append(
            {
                "name": place.projector, "word": place.word, "x": round(x, 1), "y": round(y, 1), "health": health,
                "life": lives.get(place.projector, 0.0), "arc": _arc(x, y, lives.get(place.projector, 0.0)),
            }
        )  # fmt: skip
    # Without the empty half where no one stands behind the object.
    top = min([44.0, *(one["y"] - 34 for one in drawn)])
    return [one | {"top": round(top)} for one in drawn]


def _arc(x: float, y: float, share: float, radius: float = 14.5) -> str:
    """An SVG path around a place, clockwise from above: the whole circle at 1."""
    if share <= 0:
        return ""
    angle = 2 * math.pi * min(share, 0.9999)
    end_x, end_y = x + radius * math.sin(angle), y - radius * math.cos(angle)
    large = int(share > 0.5)
    return f"M{x:.1f} {y - radius:.1f}A{radius} {radius} 0 {large} 1 {end_x:.1f} {end_y:.1f}"


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
            extensions=["jinja2.ext.i18n"],
        )
        # The language is that of the present request, so one set of templates serves all.
        environment.install_gettext_callables(gettext, ngettext, newstyle=True)  # type: ignore[attr-defined]
        environment.filters |= {
            "duration": duration,
            "moment": self._moment,
            "clock": self._clock,
            "exact": self._exact,
            "percent": figures.percent,
            "number": figures.number,
            "date": self._date,
            "day": figures.day,
            "named_day": _named_day,
            "days": days.written,
            "sentence": lambda text: text[:1].upper() + text[1:],
            "said": gettext,
            "job_title": spoken.job_title,
            "event_text": spoken.event_text,
            "value_text": spoken.value_text,
        }
        environment.globals |= {
            "states": STATES, "flags": flags, "troubles": troubles, "holds": holds, "around": around,
            "language": language, "look": look, "languages": LANGUAGES, "curve": curves.curve, "bars": curves.bars,
            "grade_errors": curves.grade_errors, "drift_moves": curves.drift_moves,
            "colour_differences": curves.colour_differences, "sharpness_of": curves.sharpness_of,
            "source_word": lambda kind: spoken.SOURCES.get(kind, ""), "nothing_yet": NOTHING_YET,
            "drift_word": lambda advice: spoken.DRIFTS.get(advice, advice), "nothing_plays": NOTHING_PLAYS,
            "mark_unknown": UNKNOWN,
            "scene_word": lambda scene: gettext(spoken.SCENES.get(scene.name, scene.name.removesuffix(".blend"))),
        }  # fmt: skip
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
            "made": str(module.made(state)),
            "lamps": str(module.lamps(state)),
            "next": str(module.next(state)),
            "around": str(module.around_object(state)),
            "first": str(module.first_steps(state)),
            "events": str(module.events(events[-EVENTS_SHOWN:][::-1])),
        }

    def _moment(self, unix_s: float) -> str:
        return self._local(unix_s, figures.moment)

    def _exact(self, unix_s: float) -> str:
        return self._local(unix_s, lambda at: figures.moment(at, seconds=True))

    def _date(self, unix_s: float) -> str:
        return self._local(unix_s, figures.day)

    def _clock(self, unix_s: float) -> str:
        """With the weekday, unless it is today."""
        today = self._local(unix_s, str_of_date) == self._local(time.time(), str_of_date)
        return self._local(unix_s, (lambda at: f"{at:%H:%M}") if today else figures.short)

    def _local(self, unix_s: float, form: Callable[[datetime], str]) -> str:
        try:
            return form(datetime.fromtimestamp(unix_s, self._zone))
        except (ValueError, OverflowError, OSError):
            # A wrong time in a file must not break a page.
            return gettext(UNKNOWN_TIME)


def _named_day(text: str) -> str:
    """A date of a file, "2026-12-24", as the language writes it; anything else as it is."""
    try:
        return figures.day(date.fromisoformat(text))
    except ValueError:
        return text


def str_of_date(at: datetime) -> str:
    return at.date().isoformat()


def _source(name: str) -> str:
    return resources.files("controller.panel").joinpath("templates", name).read_text("utf-8")
