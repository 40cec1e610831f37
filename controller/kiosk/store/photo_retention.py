"""Deletes old photographs, so that the nightly checks of a kiosk do not fill its disk.

Their results stay: calibrations, grades, reports, pictures, journals.
"""

from __future__ import annotations

import shutil
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from controller.core.storage import sync_folder
from controller.kiosk.store.event_log import Decision, EventLog
from controller.run.journal import Journal, JournalError
from controller.stage.artefacts.names import CAPTURES, run_kind

GOING: Final = f"{CAPTURES}.going"
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
    for run in runs:
        going = run / GOING
        if not going.exists():
            (run / CAPTURES).rename(going)
            sync_folder(run)
        freed += sum(path.lstat().st_size for path in going.rglob("*"))
        shutil.rmtree(going)
    return freed


def _has_photographs(run: Path) -> bool:
    return (run / CAPTURES).is_dir() or (run / GOING).is_dir()


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
        log.add(Decision("photographs-kept", f"Old photographs could not be deleted: {error.strerror}.",
                          "Check the disk and the permissions of the stage's folder.", "warning"))  # fmt: skip
        return
    log.add(Decision("photographs-removed", f"The photographs of {len(runs)} old runs were deleted, "
                      f"which freed {freed / 1e6:.0f} MB. Their results are kept."))  # fmt: skip
