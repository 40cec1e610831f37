"""An uploaded picture wrapped around the calibrated object, as the camera then sees it."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def wrapped(run: Path, names: tuple[str, ...], picture: Path) -> bytes:
    """A PNG of the size of the camera's view, transparent beside the object; ``run``: a finished calibration.

    Raises UsageError("target-unreadable") and what reading a calibration raises.
    """
    import cv2

    from controller.optics.solve.targets.values import linear_to_srgb
    from controller.stage.artefacts.calibrated import Calibrated
    from controller.stage.steps.appearance.requests import make_target

    made = make_target("photograph", picture, {}, Calibrated(run, names))
    seen = np.rint(255 * np.dstack([linear_to_srgb(made.image), made.mask])).astype(np.uint8)
    return cv2.imencode(".png", cv2.cvtColor(seen, cv2.COLOR_RGBA2BGRA))[1].tobytes()
