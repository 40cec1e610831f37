"""Makes room on a disk that fills: what is cheap to lose goes first, and what plays and what it was made of stays.

1. photographs of old runs, but for the two newest good runs of each kind;
2. what a restore replaced, and all archives but the newest of each kind;
3. old runs, but for the newest of each kind, and those from which a bundle was made.
"""

from __future__ import annotations

import shutil
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

from controller.bundle.format import Index
from controller.kiosk.store import archive
from controller.kiosk.store.photo_retention import expired, outcome_of, purge
from controller.run.journal import Journal
from controller.stage.artefacts.names import run_kind

GOING: Final = ".going"
"""The end of a run's name while it is removed."""


def make_room(stage: Path, enough: Callable[[], bool], *, keep_runs: int, used: set[str]) -> list[str]:
    """Remove, in this order, until there is ``enough``; returns what was removed, as words for a sentence.

    ``used``: names of runs that stay whatever their age. Raises OSError.
    """
    removed: list[str] = []
    for what, remove in _candidates(stage, keep_runs, used):
        if enough():
            break
        remove()
        removed.append(what)
    return removed


def runs_of(*indexes: Index | None) -> set[str]:
    """The names of the runs from which these bundles were made."""
    return {index.calibration for index in indexes if index is not None}


def _candidates(stage: Path, keep_runs: int, used: set[str]) -> Iterator[tuple[str, Callable[[], object]]]:
    for going in (stage / "runs").glob(f"*{GOING}"):
        yield f"the rest of {going.stem}", lambda going=going: shutil.rmtree(going)  # type: ignore[misc]
    for run in sorted(expired(stage, now_s=float("inf"))):
        yield f"the photographs of {run.name}", lambda run=run: purge([run])  # type: ignore[misc]
    if (stage / archive.REPLACED).exists():
        yield "what the last restore replaced", lambda: shutil.rmtree(stage / archive.REPLACED)
    for kind in ("diagnostics", "backup"):
        for old in sorted((stage / archive.FOLDER).glob(f"{kind}-*"))[:-1]:
            yield old.name, old.unlink
    for run in _old_runs(stage, keep_runs, used):
        yield f"the run {run.name}", lambda run=run: _remove(run)  # type: ignore[misc]


def _old_runs(stage: Path, keep_runs: int, used: set[str]) -> list[Path]:
    kinds = defaultdict[str, list[Path]](list)
    for run in sorted((stage / "runs").glob("*-*-*"), reverse=True):
        if (run / Journal.FILE).is_file():
            kinds[run_kind(run)].append(run)
    old = [run for runs in kinds.values() for run in runs[keep_runs:] if run.name not in used]
    # One that was killed may go on.
    return sorted(run for run in old if outcome_of(run) is not None)


def _remove(run: Path) -> None:
    # First its name, so that a power cut leaves no half of a run.
    going = run.with_name(f"{run.name}{GOING}")
    run.rename(going)
    shutil.rmtree(going)
