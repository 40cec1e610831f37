"""The photographs that come in while a job runs, in the folders in which the capturing writes them."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np

from controller.kiosk.api.photograph import AGE_S, newest_photograph
from controller.stage.artefacts.names import CAPTURES


def taken(folder: Path, name: str, level: int, at_s: float) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.jpg").write_bytes(cv2.imencode(".jpg", np.full((640, 960, 3), level, np.uint8))[1].tobytes())
    (folder / f"{name}.json").write_text("{}")
    for one in (folder / f"{name}.jpg", folder / f"{name}.json", folder):
        os.utime(one, (at_s, at_s))


def level_of(picture: bytes | None) -> float:
    assert picture is not None
    found = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)
    assert found is not None
    assert max(found.shape) <= 480
    return float(found.mean())


def test_the_newest_one_of_all_steps_of_all_runs_is_shown(tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    taken(runs / "20260101-100000-calibrate" / CAPTURES / "black", "0", 30, 1000.0)
    taken(runs / "20260102-100000-calibrate" / CAPTURES / "black", "0", 60, 2000.0)
    assert abs(level_of(newest_photograph(tmp_path, 2001.0)) - 60) < 3
    taken(runs / "20260102-100000-calibrate" / CAPTURES / "codes-left", "1", 200, 2005.0)
    assert abs(level_of(newest_photograph(tmp_path, 2006.0)) - 200) < 3


def test_one_of_another_job_is_not_shown(tmp_path: Path) -> None:
    taken(tmp_path / "runs" / "20260101-100000-calibrate" / CAPTURES / "black", "0", 30, 1000.0)
    assert newest_photograph(tmp_path, 1001.0 + AGE_S) is None
    assert newest_photograph(tmp_path, 1002.0, since_s=1001.0) is None
    assert newest_photograph(tmp_path, 1002.0, since_s=999.0) is not None
    assert newest_photograph(tmp_path / "nothing", 1000.0) is None
