"""Takes inventories by itself: after each calibration or check that graded well, and once a night."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from datetime import datetime
from itertools import chain
from pathlib import Path
from typing import Final, NamedTuple

from controller.config.models import StageTables
from controller.core.errors import VelaturaError
from controller.core.text import printable
from controller.kiosk.changes import inventory
from controller.kiosk.changes.devices import lens_facts, settings_facts, shown_facts
from controller.kiosk.changes.inventory import Fact, Inventory
from controller.kiosk.changes.machine import Machine
from controller.kiosk.outputs import outputs_of_x
from controller.kiosk.store.event_log import EventLog
from controller.kiosk.values import Change, Changes
from controller.stage.artefacts.grade import is_graded, passes
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.names import json_path, read_json, run_kind
from controller.stage.sessions.calibrations import finished_calibrations
from hal.notices import Level, Notice


class _Kind(NamedTuple):
    """``title`` of a kind of fact, in a sentence; what to do ``if_changed``."""

    title: str
    if_changed: str


_MEASURE: Final = "Recalibrate (quick) when the stage is closed."
_OLD_ONE: Final = "If the picture is worse than before, install the version of before."
KINDS: Final = {
    "kernel": _Kind("The kernel", f"{_OLD_ONE} It is in the boot menu."),
    "gpu driver": _Kind(
        "The driver of the graphics card", f"Look at the outputs: `velatura kiosk identify`. {_OLD_ONE}"
    ),
    "gpu": _Kind("The graphics card", "Type `velatura kiosk install --outputs`, then look at the outputs."),
    "package": _Kind("The package", _OLD_ONE),
    "edid": _Kind(
        "The display at output",
        "Check its cable, and whether it is the projector of before. If it is another one, calibrate the stage.",
    ),
    "mode": _Kind(
        "The mode of output",
        "Set the mode of before: the calibration holds only for that one. "
        "`velatura kiosk install --outputs` writes it again.",
    ),
    "output order": _Kind(
        "The place of output",
        "Put the cables as they were, or correct the outputs in stage.toml. "
        "`velatura kiosk identify` shows which projector is which.",
    ),
    "serial adapter": _Kind(
        "The serial adapter", "Plug it in where it was, or correct the port in stage.toml. `velatura doctor` finds it."
    ),
    "projector": _Kind("The projector", "If it was exchanged, calibrate the stage."),
    "projector firmware": _Kind("The firmware of projector", f"Check its picture settings. {_MEASURE}"),
    "input": _Kind("The input of projector", "Choose the input of before with its remote control."),
    "keystone": _Kind(
        "The keystone of projector", "Set it as before with its remote control. Otherwise calibrate the stage."
    ),
    "lamp mode": _Kind("The lamp mode of projector", f"Set it as before with its remote control. Or: {_MEASURE}"),
    "camera body": _Kind("The camera", "Connect the camera of before, or calibrate the stage."),
    "camera firmware": _Kind("The firmware of the camera", "Take test shots. If they look as before, do nothing."),
    "camera settings": _Kind("The camera's", "Set the dial to M and the lens to manual focus, then take test shots."),
    "lens": _Kind("The camera's lens", "Mount the lens of before, set to the same length, or calibrate the stage."),
    "settings": _Kind("In stage.toml,", "If this was changed by mistake, correct it in the panel under Settings."),
    "clock": _Kind("The clock:", "Check the time zone and the time server. Opening hours depend on them."),
    "network": _Kind("The network:", "Check the cable and the router. Projectors and people reach each other by it."),
}
"""By the kind of a fact, in the order in which they are shown."""
COME_AND_GO: Final = frozenset({"gpu driver", "gpu", "package", "edid", "serial adapter", "settings", "network"})
"""Kinds of which one that is not listed is not there; of the others it can't be read now."""


def changes(before: Inventory, now: Inventory, nights: Iterable[Inventory] = ()) -> tuple[Change, ...]:
    """What differs, in the order of ``KINDS``; ``nights``: those between, which tell since when."""
    was, new = _by_key(before.facts), _by_key(now.facts)
    # In each: a night in which a device was off does not know.
    seen = [(night.taken_unix_s, _by_key(night.facts)) for night in nights]
    found = []
    swapped = _swapped(was, new)
    for key in sorted(was.keys() | new.keys(), key=lambda key: (_place(key[0]), key[1])):
        absent = "" if key[0] in COME_AND_GO else None
        old, fresh = was.get(key, absent), new.get(key, absent)
        if old == fresh or old is None or fresh is None or key in swapped:
            continue
        since = next((at for at, facts in seen if facts.get(key, absent) not in (None, old)), now.taken_unix_s)
        found.append(_change(*key, old, fresh, since))
    if swapped:
        names = " and ".join(sorted(name for _, name in swapped))
        sentence = f"The displays at outputs {names} have changed places."
        found.append(
            Change("output order", names, "", "", sentence, KINDS["output order"].if_changed, now.taken_unix_s)
        )
    return tuple(sorted(found, key=lambda one: _place(one.kind)))


def unknown(before: Inventory, now: Inventory) -> tuple[str, ...]:
    """What could be read on the good day and can't be now, so that it is not compared."""
    new = _by_key(now.facts)
    keys = [(fact.kind, fact.name) for fact in before.facts if fact.value is not None]
    lost = [key for key in keys if new.get(key, "" if key[0] in COME_AND_GO else None) is None]
    return tuple(printable(f"{_title(kind)} {name}".strip()) for kind, name in lost)


def _by_key(facts: Sequence[Fact]) -> dict[tuple[str, str], str | None]:
    return {(fact.kind, fact.name): fact.value for fact in facts}


def _swapped(
    was: dict[tuple[str, str], str | None], new: dict[tuple[str, str], str | None]
) -> frozenset[tuple[str, str]]:
    """The outputs whose displays are the same as before, at each other's places: somebody swapped cables."""
    moved = [key for key in was if key[0] == "edid" and key in new and was[key] != new[key]]
    before, after = sorted(str(was[key]) for key in moved), sorted(str(new[key]) for key in moved)
    return frozenset(moved) if before == after else frozenset()


def _change(kind: str, name: str, old: str, fresh: str, since_unix_s: float) -> Change:
    title = f"{_title(kind)} {name}".strip()
    if not old:
        sentence = f"{title} is new: {fresh}."
    elif not fresh:
        sentence = f"{title} is gone; it was {old}."
    else:
        sentence = f"{title} was {old}, and is now {fresh}."
    remedy = KINDS[kind].if_changed if kind in KINDS else ""
    return Change(kind, printable(name), printable(old), printable(fresh), printable(sentence), remedy, since_unix_s)


def _title(kind: str) -> str:
    return KINDS[kind].title if kind in KINDS else kind


def _place(kind: str) -> int:
    order = list(KINDS)
    return order.index(kind) if kind in KINDS else len(order)


NIGHT_H: Final = range(3, 15)
"""Local hours in which a night's inventory is taken: a computer that is off at night takes it in the morning."""
COMPLETE_S: Final = 600.0
MOST_NAMED: Final = 5
_UNREADABLE: Final = (OSError, ValueError, KeyError, TypeError, AttributeError)


def take(stage: Path, tables: StageTables | None, devices: tuple[Fact, ...], machine: Machine, run: str) -> Inventory:
    """An inventory now. Seconds. ``tables``: the settings; ``devices``: facts of the opened devices."""
    shown = tuple(shown_facts(outputs_of_x()))
    settings = () if tables is None else settings_facts(tables)
    facts = chain(machine.facts(), shown, devices, lens_facts(stage), settings)
    return Inventory(time.time(), run, tuple(facts))


def since_good(stage: Path, now: Inventory) -> Changes:
    """What changed since the last good day."""
    good = inventory.last_good(stage)
    if good is None:
        return Changes(None, "", (), ())
    nights = inventory.nights_after(stage, good.taken_unix_s)
    return Changes(good.taken_unix_s, good.run, changes(good, now, nights), unknown(good, now))


def newest_good(stage: Path, worst_grade: float) -> str:
    """The newest run that graded well, or a drift check that found nothing; empty if there is none.

    Raises JournalError for a journal that can't be used now.
    """
    finished = {run.name for run in finished_calibrations(stage)}
    for run in sorted((stage / "runs").glob("*"), reverse=True):
        try:
            if run.name in finished and is_graded(run):
                # What came before a bad one tells nothing of the day.
                return run.name if passes(run, worst_grade) else ""
            if run_kind(run) == "drift":
                # Not by ``artefacts.drift``, which loads the calibration's code before the first picture.
                return run.name if read_json(json_path(run, StepKind.DRIFT))["advice"] == "nothing" else ""
        except (VelaturaError, *_UNREADABLE):
            continue
    return ""


class InventoryWatch:
    """``taken`` takes an inventory after the named run; ``worst_grade``: the largest error that grades well, in
    per cent; ``busy``: whether a job runs, which has the camera. One thread calls ``step``.
    """

    def __init__(
        self, stage: Path, taken: Callable[[str], Inventory], worst_grade: Callable[[], float], log: EventLog, *,
        busy: Callable[[], bool], wall: Callable[[], float] = time.time,
    ) -> None:  # fmt: skip
        self._stage, self._taken, self._worst_grade, self._log = stage, taken, worst_grade, log
        self._busy, self._wall = busy, wall
        self._complete_at_s = self._again_at_s = 0.0
        self._failed = False

    def step(self) -> None:
        """Take an inventory if one is due. One that can't be written is tried again, and reported once."""
        if self._busy() or _ahead(self._again_at_s, self._wall()):
            return
        try:
            self._take_due()
        except (VelaturaError, OSError) as error:
            self._again_at_s = self._wall() + COMPLETE_S
            if not self._failed:
                self._log.add(_not_kept(error))
            self._failed = True
        else:
            self._failed = False

    def _take_due(self) -> None:
        good, now_s = inventory.last_good(self._stage), self._wall()
        run = newest_good(self._stage, self._worst_grade())
        if run and (good is None or run > good.run):
            self._after_good(good, run)
        elif good is not None and not _ahead(self._complete_at_s, now_s):
            self._complete_at_s = now_s + COMPLETE_S
            self._complete(good)
        now = datetime.fromtimestamp(now_s).astimezone()
        key = f"inventory {now.date().isoformat()}"
        if now.hour in NIGHT_H and key not in self._log.done():
            self._night(f"{now:%Y%m%d}")
            self._log.mark_done(key, "taken")

    def _after_good(self, before: Inventory | None, run: str) -> None:
        taken = self._taken(run)
        if self._busy():
            # A job that began meanwhile has the camera.
            return
        inventory.keep_good(self._stage, taken)
        found = () if before is None else changes(before, taken)
        more = f" It differs in {len(found)} points from the good day before." if found else ""
        self._log.add(Notice("inventory-taken", f"What the kiosk consists of was recorded after a good grade.{more}"))

    def _complete(self, good: Inventory) -> None:
        """Add what could not be read on the good day: many projectors tell their settings only while lit."""
        if all(fact.value is not None for fact in good.facts):
            return
        now = {(fact.kind, fact.name): fact.value for fact in self._taken("").facts}
        facts = tuple(
            replace(fact, value=now.get((fact.kind, fact.name))) if fact.value is None else fact for fact in good.facts
        )
        if facts != good.facts:
            inventory.keep_good(self._stage, replace(good, facts=facts))

    def _night(self, day: str) -> None:
        taken = self._taken("")
        before = list(inventory.nights_after(self._stage, 0.0))[-1:]
        inventory.keep_night(self._stage, day, taken)
        # Each change is reported in its first night.
        fresh = changes(before[0], taken) if before else ()
        unreported = [one for one in since_good(self._stage, taken).changes if (one.kind, one.name) in
                {(new.kind, new.name) for new in fresh}]  # fmt: skip
        if unreported:
            text = " ".join(one.sentence for one in unreported[:MOST_NAMED])
            more = f" And {len(unreported) - MOST_NAMED} more." if len(unreported) > MOST_NAMED else ""
            remedy = "See `velatura kiosk changes`, or the page Changes in the panel."
            self._log.add(Notice("stage-changed", f"Since the last good day: {text}{more}", remedy, Level.WARNING))


def _ahead(at_s: float, now_s: float) -> bool:
    """Whether that time is still to come; not if the clock was set back since."""
    return now_s < at_s <= now_s + COMPLETE_S


def _not_kept(error: VelaturaError | OSError) -> Notice:
    if isinstance(error, VelaturaError):
        why, remedy = error.what, error.remedy
    else:
        why, remedy = f"{error.strerror or error}.", "Check the disk of the stage."
    what = f"What the kiosk consists of could not be recorded. {why}"
    return Notice("inventory-not-kept", what, f"It is tried again. {remedy}", Level.WARNING)
