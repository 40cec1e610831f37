"""Makes room on a disk that fills: what is cheap to lose goes first, and what plays and what it was made of stays.

1. photographs of old runs, but for the two newest good runs of each kind;
2. what a restore replaced, and all archives but the newest of each kind;
3. old runs, but for the newest of each kind, and those from which a bundle was made.
"""

from __future__ import annotations

import shutil
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final

from controller.bundle.format import Index
from controller.core.storage import sync_folder
from controller.kiosk.store import archive
from controller.kiosk.store.event_log import EventLog
from controller.run.journal import Journal, JournalError
from controller.stage.artefacts.names import CAPTURES, run_kind
from controller.stage.artefacts.views import VIEWS
from hal.notices import Level, Notice

PHOTOGRAPHS_GOING: Final = f"{CAPTURES}.going"
"""The name during the removal, so that a power cut leaves no incomplete folder of photographs."""
KEPT_OF_A_KIND: Final = 2
"""The newest good runs of each kind keep their photographs, to which drift check and calibration compare."""
KEPT_S: Final = 14 * 86400.0


def expired(stage: Path, *, now_s: float) -> list[Path]:
    """Runs whose photographs may be deleted: ended ``KEPT_S`` ago, with ``KEPT_OF_A_KIND`` newer good runs.

    Runs are counted by kind, the end of the folder's name; a good run ended without error. A run with an unreadable
    journal is kept and not counted. ``now_s``: Unix seconds
    """
    kinds = defaultdict[str, list[Path]](list)
    for run in sorted((stage / "runs").glob("*-*-*"), reverse=True):
        if (run / Journal.FILE).is_file():
            kinds[run_kind(run)].append(run)
    result: list[Path] = []
    for runs in kinds.values():
        good = 0
        for run in runs:
            outcome = outcome_of(run)
            old = now_s - (run / Journal.FILE).stat().st_mtime >= KEPT_S
            if good >= KEPT_OF_A_KIND and outcome is not None and old and _has_photographs(run):
                result.append(run)
            good += outcome == "done"
    return result


def purge(runs: Sequence[Path]) -> int:
    """Delete the photographs of these runs; returns the freed bytes. Raises OSError."""
    freed = 0
    folders = (folder for run in runs for folder in (run, *run.glob(f"{VIEWS}/*")))
    for folder in filter(_has_photographs, folders):
        going = folder / PHOTOGRAPHS_GOING
        if not going.exists():
            (folder / CAPTURES).rename(going)
            sync_folder(folder)
        freed += sum(path.lstat().st_size for path in going.rglob("*"))
        shutil.rmtree(going)
    return freed


def _has_photographs(run: Path) -> bool:
    return (run / CAPTURES).is_dir() or (run / PHOTOGRAPHS_GOING).is_dir()


def outcome_of(run: Path) -> str | None:
    """The outcome of the last start; None if it is running, was killed, or is unknown."""
    try:
        with Journal(run) as journal:
            outcomes = journal.outcomes()
    except JournalError:
        return None
    return outcomes[-1][1] if outcomes else None


TIDY_S: Final = 3600.0


def purge_old_photographs(stage: Path, log: EventLog, clock: Callable[[], float]) -> None:
    """Delete the photographs of the ``expired`` runs, and log it; log a disk error, too."""
    runs = expired(stage, now_s=clock())
    if not runs:
        return
    try:
        freed = purge(runs)
    except OSError as error:
        log.add(Notice("photographs-kept", f"Old photographs could not be deleted: {error.strerror}.",
                          "Check the disk and the permissions of the stage's folder.", Level.WARNING))  # fmt: skip
        return
    log.add(Notice("photographs-removed", f"The photographs of {len(runs)} old runs were deleted, "
                      f"which freed {freed / 1e6:.0f} MB. Their results are kept."))  # fmt: skip


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
    # One that was killed may continue.
    return sorted(run for run in old if outcome_of(run) is not None)


def _remove(run: Path) -> None:
    # First its name, so that a power cut leaves no half of a run.
    going = run.with_name(f"{run.name}{GOING}")
    run.rename(going)
    shutil.rmtree(going)
