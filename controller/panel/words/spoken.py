"""Short words of the kiosk's own that pages show in the visitor's language. Names and sentences with names stay as they
are."""

from __future__ import annotations

import re
from typing import Final

from controller.kiosk.state import LiveValue
from controller.panel.words import figures
from controller.panel.words.language import gettext
from controller.panel.words.language import mark as _

PLACES: Final = (
    _("in front"), _("left"), _("right"), _("above"), _("below"), _("behind"),
    _("left above"), _("left below"), _("right above"), _("right below"), _("behind left"), _("behind right"),
    _("behind above"), _("behind below"), _("behind left above"), _("behind left below"), _("behind right above"),
    _("behind right below"),
)  # fmt: skip
JOBS: Final = (
    _("Test shots"), _("Drift check"), _("Quick recalibration"), _("Recalibration of projector"),
    _("Full recalibration"), _("Photographing"), _("Publishing appearances"), _("New appearance"), _("Report of"),
    _("Frames without projector"), _("Frames for the loss of a projector"),
)  # fmt: skip
EVENTS: Final = (_("opens"), _("closes"), _("drift check"))
KINDS: Final = (
    _("projector"),
    _("camera"),
    _("display"),
    _("keys"),
    _("key panel"),
    _("relay"),
    _("sensor"),
    _("buttons"),
    _("disk"),
    _("player"),
)
LEVELS: Final = (_("info"), _("warning"), _("error"))
ROLES: Final = (_("viewer"), _("operator"), _("technician"))
RUNS: Final = (_("full"), _("quick"), _("projector"), _("calibrate"), _("demo"))
MEASURED: Final = (_("test shots"), _("calibration"))
LABELS: Final = (
    _("Battery"), _("Free"), _("Hours"), _("Lamp"), _("Light"), _("Model"), _("Projector's counter"),
    _("Space for"), _("Stable in"), _("Warnings"),
)  # fmt: skip
VALUES: Final = (
    _("dark"), _("cooling"), _("lighting"), _("lit"), _("lost"), _("broken"),
    _("{0} h with Velatura, {1} strikes"), _("{0} h"), _("{0} s"), _("{0} %"), _("{0} pictures"), _("{0} GB of {1} GB"),
    _("{0} lux (dark enough to calibrate)"), _("{0} lux (too bright to calibrate)"),
    _("on"), _("off"), _("unchanged"), _("on until the lamps have cooled"),
    _("on, because it is unknown whether the lamps have cooled"),
)  # fmt: skip
"""Patterns of the devices' values."""
REASONS: Final = (
    _("The stage is not set up yet."), _("No lamp gives light."), _("No lamp gave light in time."),
    _("It starts when the lamps are lit and steady."), _("The stage is recalibrated."),
    _("It opens when the lamps have cooled."),
    _("Nothing has moved or dimmed since the calibration."),
)  # fmt: skip
EVENT_TEXTS: Final = (
    _("The kiosk is starting."), _("The kiosk has stopped."), _("The player is running."),
    _("The player shows what it should again."), _("The waiting jobs were cancelled."),
    _("The stage follows the schedule again."), _("The system time is known again."),
    _("An operator asked to open the stage."), _("An operator asked to close the stage."),
    _("Frames for the loss of any single projector are ready."), _("The test shots are done. See the aiming page."),
    _("The stage is powering: light is needed."), _("The stage is warming."), _("The stage is ready."),
    _("The stage is playing: open."), _("The stage is playing: every projector gives light again."),
    _("The stage is ready: closed."), _("The stage is cooling: closed."), _("The stage is cooling: nothing to do."),
    _("The stage is off: every lamp is off or cooling by itself."), _("The player ended unexpectedly."),
    _("The player did not answer."), _("The newest bundle plays again."), _("The room is dark again."),
    _("The technician's keys work again."), _("Alerts are sent again."),
)  # fmt: skip
"""Whole texts of the event log."""
EVENT_PATTERNS: Final = (
    _("Started: {0}."), _("The player shows {0}."), _("The lamp of projector {0} is being switched on."),
    _("{0} logged in from {1}."), _("{0} logged out."), _("An operator chose the appearance {0}."),
    _("A new bundle is installed: {0}."), _("{0} is connected again."), _("Mains on: {0}."), _("Mains off: {0}."),
    _("The report of {0} is written. See the results."), _("Frames without {0} are ready."),
    _("{0} waits, and is done later."), _("The disk has {0} GB of free space again."),
)  # fmt: skip
"""Texts of the event log with names in them."""
_MATCHES: Final = [(re.compile(re.sub(r"\\\{\d\\\}", "(.+)", re.escape(one))), one) for one in EVENT_PATTERNS]
SOURCES: Final = {
    "photograph": _("a photograph wrapped around the object"), "pattern": _("another pattern"),
    "checkerboard": _("a checkerboard"), "gloss": _("a gloss"), "recolour": _("recoloured"),
    "picture": _("a picture as seen from the camera"), "blender": _("rendered by Blender"),
    "texture": _("a picture painted on the object"), "restoration": _("restored"),
}  # fmt: skip
"""By the kind in stage.toml."""
SCENES: Final = {
    "marble": _("Marble"), "gold": _("Gold"), "glazed": _("Blue glaze"), "lowered-head": _("Bent forward"),
}  # fmt: skip
"""The scenes that come with Velatura, by their names."""
DRIFTS: Final = {
    "nothing": _("nothing has moved or dimmed"), "quick": _("a quick recalibration is needed"),
    "full": _("a full recalibration is needed"), "look": _("a person has to look at the stage"),
}  # fmt: skip
"""By the advice of a drift check."""


def value_text(value: LiveValue) -> str:
    """A device's value with its words and numbers in the language."""
    if not value.pattern:
        return value.text
    return gettext(value.pattern).format(*(figures.number(one, value.digits) for one in value.numbers))


def event_text(text: str) -> str:
    """A line of the event log in the language, as far as it is one of the kiosk's own usual ones."""
    for pattern, words in _MATCHES:
        if match := pattern.fullmatch(text):
            return gettext(words).format(*map(job_title, match.groups()))
    return gettext(text)


def job_title(name: str) -> str:
    """A job's name, whose first words say what it does and whose others are names."""
    for title in sorted(JOBS, key=len, reverse=True):
        if name == title or name.startswith(f"{title} "):
            return gettext(title) + name[len(title) :]
    return name
