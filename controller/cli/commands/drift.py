"""``velatura drift``."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from controller.cli.running import Json, StageFolder, work

if TYPE_CHECKING:
    from controller.run.progress import Reporter


def drift(stage: StageFolder, as_json: Json = False) -> None:
    """Check with a few photographs whether anything moved, or a lamp dimmed, since the calibration."""

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from controller.stage.services.recalibrate import check_drift
        from controller.stage.sessions.session import OwnSession

        return check_drift(session=OwnSession(stage), details=as_json, reporter=reporter, cancel=cancel)

    work(do, as_json=as_json, stage=stage)
