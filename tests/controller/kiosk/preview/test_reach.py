"""The shares and the map of what of a target is in reach; tests/end_to_end/test_kiosk_targets.py has a real stage."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from controller.core.errors import UsageError
from controller.kiosk.preview.reach import BRIGHT, COLOURFUL, DARK, FOLDER, UNLIT, kinds_of, map_of, reach
from controller.optics.solve.reach.feasibility import Feasibility
from controller.stage.sessions.check import check_stage
from tests.controller.kiosk.vase import graded_run, vase


def test_each_pixel_has_one_reason_and_one_colour() -> None:
    bright = np.array([[False, True, False, True, False, False]])
    dark = np.array([[False, False, True, True, False, False]])
    reachable = np.array([[True, False, False, False, True, False]])
    asked = np.array([[True, True, True, True, False, False]])
    none, possible = np.zeros((1, 6), np.bool_), Feasibility(bright, dark, reachable, 0.0)
    alike = kinds_of(possible, asked, np.array([[False, False, True, False, False, True]]))
    assert np.flatnonzero(alike["share"]).tolist() == [0, 2], "no one sees the difference"
    kinds = kinds_of(possible, asked, none)
    assert [np.flatnonzero(kinds[name]).tolist() for name in ("share", "too_bright", "too_dark", "too_colourful")] == [
        [0], [1], [2], [3]
    ]  # fmt: skip
    drawn = map_of(kinds, np.full((1, 6), 100, np.uint8))
    assert [tuple(map(int, pixel)) for pixel in drawn[0]] == [(90, 90, 90), BRIGHT, DARK, COLOURFUL, UNLIT, UNLIT]


def test_without_a_calibration_it_says_so(tmp_path: Path) -> None:
    stage = vase(tmp_path)
    with pytest.raises(UsageError) as caught:
        reach(check_stage(stage), stage / "target.png")
    assert caught.value.code == "not-calibrated"


def test_pictures_of_what_can_be_reached_do_not_fill_the_disk_in_months(tmp_path: Path) -> None:
    stage = vase(tmp_path)
    graded_run(stage, "20260101-100000-calibrate", {"left": 0.01})
    (stage / "target.png").write_bytes(b"any")
    folder = stage / FOLDER
    folder.mkdir(parents=True)
    for number in range(30):
        one = folder / f"{number:024x}"
        if number % 2:
            one.mkdir()
            (one / "map.png").write_bytes(b"a map")
        else:
            one.with_suffix(".png").write_bytes(b"a map of an older version")
            one = one.with_suffix(".png")
        os.utime(one, (1e9 + number, 1e9 + number))
    with pytest.raises(UsageError):
        reach(check_stage(stage), stage / "target.png")
    assert sorted(int(one.stem, 16) for one in folder.iterdir()) == list(range(11, 30))
