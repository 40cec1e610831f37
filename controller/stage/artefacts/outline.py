"""What a person drew around the object, in the folder of a run: it counts instead of what was found."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from controller.stage.artefacts.names import read_json, write_json

Regions = Sequence[Sequence[tuple[float, float]]]
"""Corners (x, y) of each, from 0 to 1 of the camera's picture."""
FILE: Final = "outline.json"


def keep_outline(run: Path, regions: Regions) -> None:
    """Use these in this run; none: what is found."""
    if regions:
        write_json(run / FILE, {"regions": regions})
    else:
        (run / FILE).unlink(missing_ok=True)


def read_outline(run: Path) -> Regions:
    """Those that were drawn; none: what is found counts."""
    return tuple(read_json(run / FILE)["regions"]) if (run / FILE).exists() else ()


def outline_digest(run: Path) -> str:
    """Another one for other regions; "" for none."""
    return hashlib.sha256((run / FILE).read_bytes()).hexdigest()[:16] if (run / FILE).exists() else ""
