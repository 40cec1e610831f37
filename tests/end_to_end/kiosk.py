"""A copy of a finished stage on which a kiosk may work, and what the kiosk tells."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

from controller.errors import VelaturaError
from controller.serve.control import ask
from tests import waiting
from tests.end_to_end.program import LONGEST_S


def copied(stage: Path, to: Path) -> Path:
    """What is only ever replaced is linked; databases and mapped files are written to."""

    def keep(source: str, target: str) -> None:
        (os.link if source.endswith((".npz", ".dng")) else shutil.copy2)(source, target)

    left = shutil.ignore_patterns("run")
    return Path(shutil.copytree(stage, to, symlinks=True, copy_function=keep, ignore=left))


def wait_for(what: Callable[[], bool]) -> None:
    waiting.wait_for(what, within_s=LONGEST_S, every_s=0.2)


def codes(stage: Path) -> list[str]:
    """Of the kiosk's events so far."""
    try:
        return [row["code"] for row in ask(stage, "events")]
    except VelaturaError:  # it is not there yet
        return []
