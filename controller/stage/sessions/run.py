"""Shared by every run on a stage: the stage's lock, the run's folder, marker steps, and the tape if one is recorded."""

from __future__ import annotations

import contextlib
import functools
import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from controller.core import kiosk_places
from controller.core.errors import WorkError
from controller.core.storage import exclusive, runtime_folder, runtime_path
from controller.play.control.launch import LOG_NAME
from controller.run.journal import Journal
from controller.run.runner import Step
from controller.run.state_machine import Event
from controller.run.step_id import StepId
from hal.registry import OpenContext
from hal.runtime.caches import in_use
from hal.tape import Tape

LONGEST_RUN_S = 12 * 3600.0
LOCK = "run/lock"
"""Held by the program that works on the stage."""


def marker(kind: str, title: str, *, enter: Event | None = None, leave: Event | None = None) -> Step:
    """A step that only changes the state; never skipped, so that a resumed run is in the right state, too."""
    return Step(StepId(kind), lambda _: (), title=title, weight=0.01, enter=enter, leave=leave, always=True)


def stage_lock(folder: Path) -> contextlib.AbstractContextManager[None]:
    """Hold the stage's lock. Raises UsageError("already-running")."""
    return exclusive(folder / LOCK, what_is_running="Velatura")


@contextlib.contextmanager
def used_runtime_folder(stage: Path) -> Iterator[Path]:
    """``core.storage.runtime_folder``, and ``leave_runtime_folder`` on leaving. For the holder of the stage's lock."""
    folder = runtime_folder(stage)
    try:
        yield folder
    finally:
        leave_runtime_folder(stage)


def leave_runtime_folder(stage: Path) -> None:
    """Remove the stage's runtime folder, unless a program serves in it, or it holds what somebody may still read: a
    first login, or the words of a player.

    For the holder of the stage's lock. The folder of an installed kiosk is systemd's.
    """
    folder = runtime_path(stage)
    if kiosk_places.is_installed(stage) or not folder.exists() or in_use(folder):
        return
    with contextlib.suppress(FileNotFoundError):
        if (folder / LOG_NAME).stat().st_size:
            return
    if not (folder / kiosk_places.FIRST_LOGIN).exists():
        shutil.rmtree(folder, ignore_errors=True)


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
    stamp = time.strftime(_STAMP)
    with contextlib.suppress(ValueError):
        # The newest run counts: one that was made while the clock was ahead must not stay the newest for years.
        newest = max(folder.name[:15] for folder in runs.glob("[0-9]*-[0-9]*-*"))
        if newest >= stamp:
            after = time.localtime(time.mktime(time.strptime(newest, _STAMP)) + 1)
            stamp = time.strftime(_STAMP, after)
    return runs / f"{stamp}-{name}"


_STAMP: Final = "%Y%m%d-%H%M%S"


VARIABLE: Final = "VELATURA_TAPE"
"""Environment variable with the file of the tape."""
FOLDER: Final = "tapes"


def open_context(stage: Path, *, runtime: Path | None = None) -> OpenContext:
    """What drivers get to open the devices of ``stage``. Raises WorkError("tape-not-made")."""
    return OpenContext(stage=stage, runtime=runtime, tape=_tape())


def new_tape(stage: Path, name: str) -> Path:
    """A file for a new tape of ``stage``; its folder is made. Raises WorkError("tape-not-made")."""
    try:
        (stage / FOLDER).mkdir(exist_ok=True)
    except OSError as error:
        raise _not_made(stage / FOLDER, error) from error
    return stage / FOLDER / f"{name}.tape"


def tapes(stage: Path) -> list[Path]:
    """The tapes of ``stage``, oldest first."""
    return sorted((stage / FOLDER).glob("*.tape"), key=lambda path: path.stat().st_mtime)


@functools.cache
def _tape() -> Tape | None:
    # Taken out of the environment: a process that this one starts must not write into the same file.
    path = os.environ.pop(VARIABLE, "")
    if not path:
        return None
    try:
        return Tape(Path(path))
    except OSError as error:
        raise _not_made(Path(path), error) from error


def _not_made(path: Path, error: OSError) -> WorkError:
    return WorkError(
        "tape-not-made",
        what=f"The tape {path} can't be written: {error.strerror}.",
        remedy="Give another file with --out, or check the permissions of its folder.",
    )
