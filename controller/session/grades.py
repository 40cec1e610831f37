"""The grade that a run was given, read from its folder; what gives it is in ``session.grading``."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Final

FILE: Final = "verification.json"
PICTURE: Final = "verification.png"
ACCEPTED: Final = "accepted.json"


def graded(folder: Path) -> dict[str, float] | None:
    """Per cent of relative error by projector; None for a run that was not graded."""
    path = folder / FILE
    if not path.exists():
        return None
    return {name: 100 * float(row["relative_rms"]) for name, row in json.loads(path.read_text()).items()}


def worst_of(folder: Path) -> tuple[str, float] | None:
    """The projector with the largest error, in per cent; None for a run that was not graded."""
    figures = graded(folder)
    return max(figures.items(), key=lambda item: math.inf if math.isnan(item[1]) else item[1]) if figures else None


def passes(folder: Path, worst_grade: float) -> bool:
    """Whether a run's calibration may be used: good enough, accepted by a person, or graded only later."""
    worst = worst_of(folder)
    return worst is None or worst[1] <= worst_grade or (folder / ACCEPTED).exists()
