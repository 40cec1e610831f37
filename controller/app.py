"""Running work on a stage: its lock, its journal, its lamps on before and safe afterwards."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path

from controller.checking import Checked
from controller.opening import opened
from controller.session.darkness import dark_before
from controller.session.journal import Journal
from controller.session.lighting import lit, power_steps
from controller.session.machine import Event, Machine
from controller.session.progress import Reporter
from controller.session.rig import Rig
from controller.session.runner import Runner, Step
from controller.storage import clear_unfinished_writes, exclusive
from hal.deadline import Deadline, in_seconds

LONGEST_RUN_S = 12 * 3600.0
LOCK = "run/lock"
"""Held by whoever works on the stage."""


def marker(name: str, title: str, *, enter: Event | None = None, leave: Event | None = None) -> Step:
    """A step that only moves the state machine; never skipped, so that a resumed run is in the right state too."""
    return Step(name, lambda _: (), title=title, weight=0.01, enter=enter, leave=leave, always=True)


@dataclass(frozen=True, slots=True)
class Held:
    """A stage whose lock, lamps and player somebody keeps, the kiosk; ``rig`` None for work that touches no device."""

    folder: Path
    rig: Rig | None


_HELD: ContextVar[Held | None] = ContextVar("held", default=None)


@contextlib.contextmanager
def holding(held: Held) -> Iterator[None]:
    """Inside, what runs on that stage (in this thread) uses the holder's devices and lock, and leaves its lamps lit."""
    token = _HELD.set(held)
    try:
        yield
    finally:
        _HELD.reset(token)


@contextlib.contextmanager
def stage_lock(folder: Path) -> Iterator[None]:
    """The lock of whoever works on the stage. Raises UsageError("already-running")."""
    held = _HELD.get()
    if held is not None and held.folder == folder:
        yield
        return
    with exclusive(folder / LOCK, what_is_running="Velatura"):
        yield


MakeSteps = Callable[[Rig, Path], Sequence[Step]]
"""The steps of a run on the opened stage; the path is the run's folder."""


def run_on_stage(
    checked: Checked,
    make_steps: MakeSteps,
    *,
    name: str,
    reporter: Reporter,
    cancel: threading.Event,
    around: contextlib.AbstractContextManager[object] | None = None,
    dark: bool = False,
    plays: bool = False,
    again: bool = False,
) -> Path:
    """Open the stage, run the steps of a new or unfinished run with the lamps on, and leave the lamps safe.

    ``around`` is entered before the devices are opened and left when they are closed; ``dark``: not in a bright room,
    where the stage has a light sensor; ``plays``: as in ``opened``; ``again``: a finished run of the name is gone on
    with, too, and what it has done already is not repeated. Returns the run's folder.
    Raises what the steps raise; UsageError("already-running") if another program works on the stage.
    """
    stage = checked.stage
    deadline = in_seconds(LONGEST_RUN_S, cancel)
    safety = stage.tables.safety
    held = _HELD.get()
    if held is not None and held.folder == stage.folder and held.rig is not None:
        return _run_held(held.rig, make_steps, name=name, reporter=reporter, deadline=deadline, dark=dark)
    with (
        exclusive(stage.folder / LOCK, what_is_running="Velatura"),
        around or contextlib.nullcontext(),
        opened(checked, deadline=deadline, plays=plays) as rig,
        Journal(unfinished_run(stage.folder, name, finished=again)) as journal,
    ):
        clear_unfinished_writes(journal.folder)
        machine = Machine(journal.record_change)
        first = dark_before(rig.darkness) if dark else []
        steps = [*first, *power_steps(rig, power_up_s=safety.power_up_s), *make_steps(rig, journal.folder)]
        with lit(rig, machine, power_down_s=safety.power_down_s, reporter=reporter):
            Runner(steps, journal, reporter=reporter, machine=machine).run(name, deadline=deadline)
        return journal.folder


def _run_held(
    rig: Rig, make_steps: MakeSteps, *, name: str, reporter: Reporter, deadline: Deadline, dark: bool
) -> Path:
    """As ``run_on_stage`` with lamps that are lit already, and stay so; the state machine is the holder's."""
    with Journal(unfinished_run(rig.stage, name)) as journal:
        clear_unfinished_writes(journal.folder)
        first = dark_before(rig.darkness) if dark else []
        Runner([*first, *make_steps(rig, journal.folder)], journal, reporter=reporter).run(name, deadline=deadline)
        return journal.folder


def unfinished_run(stage: Path, name: str, *, finished: bool = False) -> Path:
    """The newest run folder of ``name`` whose work was begun and not finished, or a new one, not yet made.

    ``finished``: the newest one, finished or not. For the holder of the stage's lock.
    """
    runs = stage / "runs"
    for folder in sorted(runs.glob(f"*-{name}"), reverse=True):
        if (folder / Journal.FILE).exists():
            with Journal(folder) as journal:
                outcomes = journal.outcomes()
            if finished or not outcomes or outcomes[-1][1] != "done":
                return folder
            break
    stamp = time.strftime("%Y%m%d-%H%M%S")
    return runs / f"{stamp}-{name}"
