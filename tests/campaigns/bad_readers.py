"""Commands that only read: the files that the program's own commands read once a stage is calibrated."""

from __future__ import annotations

import time
from pathlib import Path


def read_target(file: Path) -> None:
    """Read a target picture, as ``velatura appearance`` does, for a camera of 64 x 48 pixels."""
    from controller.optics.solve.targets.files import load_target

    load_target(file, (64, 48))


def read_live(source: Path) -> None:
    """Open a stream of targets, as ``velatura live`` does, and take its first picture."""
    from controller.stage.live import FolderSource, open_source

    opened = open_source(source, loop=False, rate_hz=25.0)
    if isinstance(opened, FolderSource):
        time.sleep(0.3)  # until then a damaged picture counts as half written
    opened.next(0.0)
    opened.close()


COMMANDS = (read_target, read_live)
