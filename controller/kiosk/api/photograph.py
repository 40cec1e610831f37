"""The newest photograph of the job that runs, small, for a person who watches it."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any, Final

import numpy as np

from controller.stage.artefacts.names import CAPTURES

LONGEST_PX: Final = 480
AGE_S: Final = 900.0
"""An older photograph is of another job."""
_BESIDE: Final = (".json", ".toml", ".part")
_last: dict[Path, bytes] = {}
_lock = threading.Lock()


def newest_photograph(stage: Path, now_s: float, since_s: float = 0.0) -> bytes | None:
    """As JPEG; None if no run has taken one since ``since_s``, or within ``AGE_S`` before ``now_s`` (Unix seconds)."""
    try:
        # Each step of a run has a folder of its own for its photographs.
        folders = [step for step in (stage / "runs").glob(f"*/{CAPTURES}/*") if step.is_dir()]
        newest = max(folders, key=lambda one: one.stat().st_mtime, default=None)
        if newest is None:
            return None
        files = [one for one in newest.iterdir() if one.is_file() and one.suffix.lower() not in _BESIDE]
        file = max(files, key=lambda one: one.stat().st_mtime, default=None)
        if file is None or file.stat().st_mtime < max(now_s - AGE_S, since_s):
            return None
    except OSError:
        # A run was removed in the meantime.
        return None
    with _lock:
        if file not in _last:
            picture = _small(file)
            if picture is None:
                return None
            _last.clear()
            _last[file] = picture
        return _last[file]


def _small(file: Path) -> bytes | None:
    """Not the evaluated light: what a camera shows on its back."""
    import cv2

    picture = _decoded(file)
    if picture is None:
        return None
    scale = LONGEST_PX / max(picture.shape[:2])
    size_px = (max(1, round(picture.shape[1] * scale)), max(1, round(picture.shape[0] * scale)))
    done, data = cv2.imencode(".jpg", cv2.resize(picture, size_px, interpolation=cv2.INTER_AREA))
    return data.tobytes() if done else None


def _decoded(file: Path) -> Any:
    """(rows, columns, 3) uint8 BGR, or None if it can't be read; it may be still being written."""
    import cv2
    import rawpy

    from controller.core.colour import Unsuitable
    from controller.optics.capture import linear_files

    try:
        if file.suffix.lower() in (".jpg", ".jpeg"):
            return cv2.imdecode(np.frombuffer(file.read_bytes(), np.uint8), cv2.IMREAD_REDUCED_COLOR_4)
        if linear_files.is_linear(file):
            light, _ = linear_files.read_linear(file)
            level = max(float(np.nanpercentile(light, 99.5)), 1e-9)
            shown = np.nan_to_num(np.clip(light[::2, ::2] / level, 0, 1), nan=1.0) ** (1 / 2.2)
            return np.ascontiguousarray((255 * shown).astype(np.uint8)[..., ::-1])
        with rawpy.imread(str(file)) as raw:
            try:
                thumb = raw.extract_thumb()
                if thumb.format == rawpy.ThumbFormat.JPEG:
                    return cv2.imdecode(np.frombuffer(thumb.data, np.uint8), cv2.IMREAD_REDUCED_COLOR_4)
            except rawpy.LibRawError:
                pass
            return raw.postprocess(half_size=True)[..., ::-1]
    except (OSError, ValueError, rawpy.LibRawError, Unsuitable, cv2.error):
        return None
