"""What a kiosk throws away by itself: photographs of old runs, so that months of nights do not fill its disk."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final

from controller.serve.eventlog import Decision, EventLog
from controller.session.spent import forget, spent

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
