"""Photographs that nobody needs any more: a kiosk that looks at itself every night must not fill its disk.

What was found from them stays: calibrations, grades, reports, pictures, journals.
"""

from __future__ import annotations

import shutil
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from controller.artefacts.names import CAPTURES, run_kind
from controller.core.storage import sync_folder
from controller.kiosk.store.event_log import Decision, EventLog
from controller.run.journal import Journal
from controller.run.journal_schema import JournalError

GOING: Final = f"{CAPTURES}.going"
"""While it is removed: a power cut then leaves no folder of photographs of which half is missing."""
KEPT_OF_A_KIND: Final = 2
"""The newest good runs of each kind keep theirs: the drift check and the next calibration compare with them."""
KEPT_S: Final = 14 * 86400.0


def spent(stage: Path, *, now_s: float) -> list[Path]:
    """Runs with photographs that were begun and ended ``KEPT_S`` ago, with ``KEPT_OF_A_KIND`` newer good ones.

    A run's kind is what its folder's name ends with; good is one that ended well. One whose journal can't be read is
    left alone, and counts for nothing. ``now_s``: Unix seconds
    """
    kinds = defaultdict[str, list[Path]](list)
    for run in sorted((stage / "runs").glob("*-*-*"), reverse=True):
        if (run / Journal.FILE).is_file():
            kinds[run_kind(run)].append(run)
    found: list[Path] = []
    for runs in kinds.values():
        good = 0
        for run in runs:
            outcome = _outcome(run)
            old = now_s - (run / Journal.FILE).stat().st_mtime >= KEPT_S
            if good >= KEPT_OF_A_KIND and outcome is not None and old and _has_photographs(run):
                found.append(run)
            good += outcome == "done"
    return found


def forget(runs: Sequence[Path]) -> int:
    """Remove the photographs of these runs; how many bytes that freed. Raises OSError."""
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


def _outcome(run: Path) -> str | None:
    """Of the last start; None for one that goes on, was killed, or can't be told."""
    try:
        with Journal(run) as journal:
            outcomes = journal.outcomes()
    except JournalError:
        return None
    return outcomes[-1][1] if outcomes else None


TIDY_S: Final = 3600.0


def forget_old_photographs(stage: Path, log: EventLog, clock: Callable[[], float]) -> None:
    """Remove what ``spent`` names, and say so; a disk that lets nothing be removed is told, too."""
    runs = spent(stage, now_s=clock())
    if not runs:
        return
    try:
        freed = forget(runs)
    except OSError as error:
        log.tell(Decision("photographs-kept", f"Old photographs could not be removed: {error.strerror}.",
                          "Check the disk and the rights of the stage's folder.", "warning"))  # fmt: skip
        return
    log.tell(Decision("photographs-removed", f"The photographs of {len(runs)} old runs were removed: "
                      f"{freed / 1e6:.0f} MB are free again. What was found from them stays."))  # fmt: skip
