"""Shared by every run on a stage: the stage's lock, the run's folder, marker steps."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path

from controller.core.storage import exclusive
from controller.run.journal import Journal
from controller.run.runner import Step
from controller.run.state_machine import Event
from controller.run.step_id import StepId

LONGEST_RUN_S = 12 * 3600.0
LOCK = "run/lock"
"""Held by the program that works on the stage."""


def marker(kind: str, title: str, *, enter: Event | None = None, leave: Event | None = None) -> Step:
    """A step that only changes the state; never skipped, so that a resumed run is in the right state, too."""
    return Step(StepId(kind), lambda _: (), title=title, weight=0.01, enter=enter, leave=leave, always=True)


def stage_lock(folder: Path) -> contextlib.AbstractContextManager[None]:
    """Hold the stage's lock. Raises UsageError("already-running")."""
    return exclusive(folder / LOCK, what_is_running="Velatura")


def unfinished_run(stage: Path, name: str, *, finished: bool = False) -> Path:
    """The newest run folder of ``name`` with unfinished work, or the path for a new one.

    ``finished``: the newest one, finished or not. Only for the holder of the stage's lock.
    """
    runs = stage / "runs"
    for folder in sorted(runs.glob(f"*-{name}"), reverse=True):
        if (folder / Journal.FILE).exists():
            with Journal(folder) as journal:
                # Appearances are made in the folder of their calibration: that one failed does not leave it unfinished.
                outcomes = [outcome for run, outcome in journal.outcomes() if run == name]
            if finished or not outcomes or outcomes[-1] != "done":
                return folder
            break
    stamp = time.strftime("%Y%m%d-%H%M%S")
    return runs / f"{stamp}-{name}"
