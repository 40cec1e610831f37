"""Commands that people give a kiosk, and what the monitor expects of it after them."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Mapping
from typing import Any, Final

from controller.kiosk.api.kiosk import StageKiosk
from lab.simulate.disk import STAGE
from lab.simulate.monitors.expectation import SETTLING_S, Calendar
from lab.simulate.scenarios.scenario import Incident
from lab.simulate.scenarios.system import SystemUnderTest
from lab.simulate.scheduler import Killed

CHANGES: Final = ("comment", "projector", "display")
"""What people change in stage.toml."""


@contextlib.contextmanager
def unknown_outcome_if_killed(life: SystemUnderTest, incident: Incident) -> Iterator[None]:
    """Of a command in the middle of which the program is killed, no one knows whether it was kept."""
    try:
        yield
    except Killed:
        life.monitor.expectation.unsure_until_hours()
        if incident.target == "set-schedule":
            life.doubtful_hours = incident
        raise


def verify_doubtful_hours(life: SystemUnderTest, kiosk: StageKiosk) -> None:
    """Who saved hours and got no answer looks at the panel, which serves again: were they kept?"""
    incident, life.doubtful_hours = life.doubtful_hours, None
    if incident is None:
        return
    values = json.loads(incident.arguments)
    now = kiosk.schedule()
    rows = [{"day": row.day, "opens": row.opens, "closes": row.closes} for row in now.rows]
    if (now.time_zone, rows) == (values["time_zone"], values["rows"]):
        expect(life, incident, values)


def arguments_of(life: SystemUnderTest, incident: Incident, kiosk: StageKiosk) -> dict[str, Any]:
    """The values of a command. Raises VelaturaError."""
    values: dict[str, Any] = json.loads(incident.arguments or "{}")
    if incident.target == "save-settings":
        values["text"] = _changed(kiosk.settings(), values["text"])
    return values


def _changed(text: str, what: str) -> str:
    if what == "comment":
        return f"{text.rstrip()}\n# A comment.\n"
    if what == "projector":
        plain, other = 'address = "192.0.2.1"', 'address = "192.0.2.1"\nprofile = "pjlink"'
        return text.replace(other, plain) if other in text else text.replace(plain, other)
    return (
        text.replace("power_down_s = 20.0", "power_down_s = 21.0")
        if "power_down_s = 20.0" in text
        else text.replace("power_down_s = 21.0", "power_down_s = 20.0")
    )


def edit_settings(life: SystemUnderTest, incident: Incident) -> None:
    """An administrator changes stage.toml in an editor and restarts the service, also on a full disk: many file systems
    keep some room for them.
    """
    path = STAGE / "stage.toml"
    if "stage.toml" in life.unreadable or not path.is_file():
        return
    path.write_text(_changed(path.read_text("utf-8"), incident.variant), "utf-8")
    if life.service is not None:
        life.restart(lit=True)
    life.monitor.disturb(0.0)


def cancelled(life: SystemUnderTest) -> None:
    """What runs is to end soon."""
    if life.service is not None:
        life.monitor.work_cancelled(life.service)


def expect(life: SystemUnderTest, incident: Incident, values: Mapping[str, Any]) -> None:
    """A command was accepted: what it asks for is wanted from now on."""
    monitor, now_s = life.monitor, life.world.scheduler.now_s
    if incident.target in ("start", "play", "rotate"):
        monitor.expectation.say(True)
        monitor.disturb(0.0, SETTLING_S)
        if incident.target == "start":
            monitor.lamps.forgive()
    elif incident.target == "stop":
        monitor.expectation.say(False)
        monitor.disturb(0.0, SETTLING_S)
        cancelled(life)
    elif incident.target == "set-schedule":
        # No one puts older hours back into the file.
        life.originals.pop("schedule.toml", None)
        monitor.expectation.use(Calendar(values["time_zone"], values["rows"]))
        life.news.set()
        monitor.disturb(0.0)
    elif incident.target == "test-shots":
        monitor.light_until_s = now_s + 900.0 + SETTLING_S
        monitor.light_needed()
    elif incident.target in ("save-settings", "recalibrate", "compare", "cancel"):
        monitor.disturb(0.0)
        if incident.target == "cancel":
            cancelled(life)
        elif incident.target in ("recalibrate", "compare"):
            monitor.light_needed()
    else:
        monitor.disturb(0.0, 60.0)
    if life.world.disk.full:
        life.monitor.expectation.unsure_until_hours()
