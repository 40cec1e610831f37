from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from hal.errors import DeviceError
from lab.emulated.bumps import Bump, Bumps, bumped, read_bumps, write_bumps
from plugins.emulated.core.truth import BUMPS_FILE, BenchTruth, Lens, ObjectTruth, Pose
from plugins.emulated.optics.objects import default_object
from plugins.emulated.optics.rays import project
from plugins.emulated.optics.staging import random_truth


@cache
def truth() -> BenchTruth:
    return random_truth("small", 3, default_object(), ObjectTruth("vase-and-bust", "", 3), (1, 2))


@cache
def points() -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Every fiftieth vertex of the object."""
    return default_object().vertices[::50].astype(np.float64)


def devices(of: BenchTruth) -> list[tuple[Pose, Lens]]:
    return [(of.camera.pose, of.camera.lens), *((one.pose, one.lens) for one in of.projectors)]


def pictures(of: BenchTruth) -> list[np.ndarray[tuple[int, ...], np.dtype[np.float64]]]:
    """Where the object's points lie in the camera's and in each projector's image."""
    return [project(pose, lens, points())[0] for pose, lens in devices(of)]


def test_a_turned_projector_shifts_its_own_picture_by_so_many_pixels_and_nothing_else() -> None:
    before = pictures(truth())
    after = pictures(bumped(truth(), Bumps((Bump("projector", "left", shift_px=(2.0, -1.0)),))))
    shift = after[1] - before[1]
    np.testing.assert_allclose(shift.mean(axis=0), (2.0, -1.0), atol=0.1)
    for untouched in (0, 2, 3):
        np.testing.assert_array_equal(after[untouched], before[untouched])


def test_an_object_that_moved_lies_elsewhere_for_every_device_as_if_it_had_been_moved() -> None:
    after = bumped(truth(), Bumps((Bump("object", move_mm=(3.0, 0.0, 2.0), turn_deg=(0.0, 1.0, 0.0)),)))
    angle = np.deg2rad(1.0)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    truly = points() @ turn.T + (0.003, 0.0, 0.002)
    for (pose, lens), (moved, _) in zip(devices(truth()), devices(after), strict=True):
        seen, there = project(pose, lens, truly)[0], project(moved, lens, points())[0]
        np.testing.assert_allclose(there, seen, atol=1e-6)


def test_dimming_takes_its_share_of_each_channel() -> None:
    after = bumped(truth(), Bumps((Bump("projector", "above", dim=0.1, dim_channels=(0.0, 0.0, 0.5)),)))
    before, dimmed = truth().projectors[2].light, after.projectors[2].light
    assert dimmed.brightness == pytest.approx(0.9 * before.brightness)
    np.testing.assert_allclose(np.asarray(dimmed.mixing), np.asarray(before.mixing) * (1.0, 1.0, 0.5))


def test_bumps_are_read_as_they_were_written_and_their_absence_mends_all(tmp_path: Path) -> None:
    (tmp_path / "bench").mkdir()
    bumps = (Bump("camera", shift_px=(1.0, 0.0)), Bump("ambient", factor=2.0))
    write_bumps(tmp_path, *bumps)
    assert read_bumps(tmp_path / BUMPS_FILE, truth()).bump == bumps
    write_bumps(tmp_path)
    assert bumped(truth(), read_bumps(tmp_path / BUMPS_FILE, truth())) == truth()


@pytest.mark.parametrize(
    "text",
    ['[[bump]]\nwhat = "wall"\n', '[[bump]]\nwhat = "projector"\nname = "nobody"\n', "[[bump]\n",
     '[[bump]]\nwhat = "object"\nshift_px = [1.0, 0.0]\n', '[[bump]]\nwhat = "camera"\ndim = 2.0\n'],
)  # fmt: skip
def test_bumps_that_cannot_be_are_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "bumps.toml"
    path.write_text(text)
    with pytest.raises(DeviceError):
        read_bumps(path, truth())
