"""Where a calibration's prediction is wrong, and why: a gallery for the reports."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from controller.stage.artefacts.grade import PICTURE, parts_of
from controller.stage.report.page import Gallery, ReportPicture

SHOWN: Final = 3
"""Reasons of a projector, the most important first."""
TEXT: Final = (
    "A random pattern was predicted and photographed. Colours show where the two differ by more than 5 % "
    "of the light nearby, and the likely reason; grey is good."
)


def causes_gallery(run: Path, verification: Mapping[str, Any]) -> tuple[Gallery, ...]:
    """One picture for each projector of the graded ``run``; nothing for a run from before there was such a map.

    ``verification``: ``read_grade_figures(run)``
    """
    whole = cv2.imread(str(run / PICTURE))
    if whole is None:
        return ()
    pictures = tuple(
        ReportPicture(
            f"{name}: {100 * row['relative_rms']:.2f} % error",
            part,
            large=True,
            points=tuple(reason["sentence"] for reason in row.get("reasons", [])[:SHOWN]),
        )
        for (name, row), part in zip(
            verification.items(), parts_of(np.asarray(whole[..., ::-1], np.uint8), len(verification)), strict=True
        )
    )
    return (("Where the calibration has errors, and why", TEXT, pictures),)
