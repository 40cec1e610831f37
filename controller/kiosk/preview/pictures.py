"""The pictures of a preview: the object alone, small enough for a screen."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from controller.core.arrays import ByteImage, Mask
from controller.core.storage import write_atomically
from controller.stage.report.pictures import crop_around

LONGEST_PX: Final = 960
"""The longer side."""


def write_picture(path: Path, rgb: ByteImage, seen: Mask) -> None:
    """``rgb`` (rows, columns, 3) where ``seen``, with black around it; the file's ending says how it is encoded."""
    box = crop_around(seen)
    cut: npt.NDArray[np.uint8] = np.where(seen[..., None], rgb, 0).astype(np.uint8)[box.rows, box.columns, ::-1]
    scale = LONGEST_PX / max(cut.shape[:2])
    if scale < 1:
        size_px = (max(1, round(cut.shape[1] * scale)), max(1, round(cut.shape[0] * scale)))
        cut = np.asarray(cv2.resize(cut, size_px, interpolation=cv2.INTER_AREA), np.uint8)
    write_atomically(path, cv2.imencode(path.suffix, cut)[1].tobytes())
