"""What people ask of a kiosk, and what the witness has to believe of it."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Mapping
from typing import Any, Final

from controller.kiosk.api.kiosk import StageKiosk
from lab.simulate.disk import STAGE
from lab.simulate.incidents.living import Living
from lab.simulate.incidents.script import Item
from lab.simulate.judge.calendar import Calendar
from lab.simulate.judge.wanted import SETTLING_S
from lab.simulate.scheduler import Killed

CHANGES: Final = ("comment", "projector", "display")
"""What people change in stage.toml."""


@contextlib.contextmanager
def whole(life: Living, item: Item) -> Iterator[None]:
    """Of a command in the middle of which the program is killed, nobody knows whether it was kept."""
    try:
        yield
    except Killed:
        life.witness.wanted.unsure_until_hours()
        if item.who == "set-schedule":
            life.doubtful_hours = item
        raise


def look_at_hours(life: Living, kiosk: StageKiosk) -> None:
    """Who saved hours and got no answer looks at the panel, which serves again: were they kept?"""
    item, life.doubtful_hours = life.doubtful_hours, None
    if item is None:
        return
    values = json.loads(item.arguments)
    now = kiosk.schedule()
    rows = [{"day": row.day, "opens": row.opens, "closes": row.closes} for row in now.rows]
    if (now.time_zone, rows) == (values["time_zone"], values["rows"]):
        believe(life, item, values)


def arguments_of(life: Living, item: Item, kiosk: StageKiosk) -> dict[str, Any]:
    """The values of a command. Raises VelaturaError."""
    values: dict[str, Any] = json.loads(item.arguments or "{}")
    if item.who == "save-settings":
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


def settings_edited(life: Living, item: Item) -> None:
    """An administrator changes stage.toml in an editor and restarts the service, also on a full disk: many file systems
    keep some room for them.
    """
    path = STAGE / "stage.toml"
    if "stage.toml" in life.unreadable or not path.is_file():
        return
    path.write_text(_changed(path.read_text("utf-8"), item.how), "utf-8")
    if life.service is not None:
        life.restart(lit=True)
    life.witness.disturb(0.0)


def cancelled(life: Living) -> None:
    """What runs is to end soon."""
    if life.service is not None:
        life.witness.work_cancelled(life.service)


def believe(life: Living, item: Item, values: Mapping[str, Any]) -> None:
    """A command was accepted: what it asks for is wanted from now on."""
    witness, now_s = life.witness, life.world.scheduler.now_s
    if item.who in ("start", "play", "rotate"):
        witness.wanted.say(True)
        witness.disturb(0.0, SETTLING_S)
        if item.who == "start":
            witness.lamps.forgive()
    elif item.who == "stop":
        witness.wanted.say(False)
        witness.disturb(0.0, SETTLING_S)
        cancelled(life)
    elif item.who == "set-schedule":
        # Nobody puts older hours back into the file.
        life.sound.pop("schedule.toml", None)
        witness.wanted.use(Calendar(values["time_zone"], values["rows"]))
        life.news.set()
        witness.disturb(0.0)
    elif item.who == "test-shots":
        witness.light_until_s = now_s + 900.0 + SETTLING_S
        witness.light_needed()
    elif item.who in ("save-settings", "recalibrate", "compare", "cancel"):
        witness.disturb(0.0)
        if item.who == "cancel":
            cancelled(life)
        elif item.who in ("recalibrate", "compare"):
            witness.light_needed()
    else:
        witness.disturb(0.0, 60.0)
    if life.world.disk.full:
        life.witness.wanted.unsure_until_hours()
