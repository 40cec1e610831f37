"""Takes inventories by itself: after each calibration or check that graded well, and once a night."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime
from itertools import chain
from pathlib import Path
from typing import Final

from controller.config.models import StageTables
from controller.core.errors import VelaturaError
from controller.kiosk.changes import compare, inventory
from controller.kiosk.changes.devices import lens_facts, outputs_of_x, settings_facts, shown_facts
from controller.kiosk.changes.inventory import Fact, Inventory
from controller.kiosk.changes.machine import Machine
from controller.kiosk.changes.values import Changes
from controller.kiosk.store.event_log import Decision, EventLog
from controller.stage.artefacts.grade import is_graded, passes
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.names import json_path, read_json, run_kind
from controller.stage.sessions.calibrations import finished_calibrations

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
    return Changes(good.taken_unix_s, good.run, compare.changes(good, now, nights), compare.unknown(good, now))


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
        found = () if before is None else compare.changes(before, taken)
        more = f" It differs in {len(found)} points from the good day before." if found else ""
        self._log.add(Decision("inventory-taken", f"What the kiosk consists of was recorded after a good grade.{more}"))

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
        fresh = compare.changes(before[0], taken) if before else ()
        unreported = [one for one in since_good(self._stage, taken).changes if (one.kind, one.name) in
                {(new.kind, new.name) for new in fresh}]  # fmt: skip
        if unreported:
            text = " ".join(one.sentence for one in unreported[:MOST_NAMED])
            more = f" And {len(unreported) - MOST_NAMED} more." if len(unreported) > MOST_NAMED else ""
            remedy = "See `velatura kiosk changes`, or the page Changes in the panel."
            self._log.add(Decision("stage-changed", f"Since the last good day: {text}{more}", remedy, "warning"))


def _ahead(at_s: float, now_s: float) -> bool:
    """Whether that time is still to come; not if the clock was set back since."""
    return now_s < at_s <= now_s + COMPLETE_S


def _not_kept(error: VelaturaError | OSError) -> Decision:
    if isinstance(error, VelaturaError):
        why, remedy = error.what, error.remedy
    else:
        why, remedy = f"{error.strerror or error}.", "Check the disk of the stage."
    what = f"What the kiosk consists of could not be recorded. {why}"
    return Decision("inventory-not-kept", what, f"It is tried again. {remedy}", "warning")
