"""Which shape a calibration gives, on stages made here: planes, corners, curved objects and several of them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest

from controller.core.errors import CalibrationError
from controller.optics.calibrate.geometry.shape import AskedShape, FoundShape, find_shape
from controller.optics.calibrate.geometry.values import CameraPrior
from controller.optics.calibrate.values import Correspondence

Array = npt.NDArray[np.float64]
CAMERA, PROJECTOR = (160, 120), (280, 210)
FOCAL_PX = 240.0
PLACES_DEG = ((-27.0, 6.0), (29.0, 9.0), (3.0, 26.0))
REACH_M = 1.2


def rays() -> Array:
    column, row = np.meshgrid(np.arange(CAMERA[0]), np.arange(CAMERA[1]))
    x, y = (column - (CAMERA[0] - 1) / 2) / FOCAL_PX, (row - (CAMERA[1] - 1) / 2) / FOCAL_PX
    return np.stack([x, y, np.ones_like(x)], axis=2)


def panel(tilt_deg: tuple[float, float] = (0.0, 0.0), at_m: tuple[float, float, float] = (0, 0, 1)) -> Array:
    """(rows, columns) inverse depths of an endless plane through a point, turned about x and y."""
    a, b = np.deg2rad(tilt_deg)
    normal = np.array([np.sin(b), np.cos(b) * np.sin(a), -np.cos(b) * np.cos(a)])
    return np.asarray(rays() @ normal / (normal @ np.array(at_m)))


def stage_of(points: Array, lit: list[npt.NDArray[np.bool_]], noise_px: float = 0.05) -> list[Correspondence]:
    """What the camera sees of each projector on the points (rows, columns, 3), NaN where nothing is."""
    rng, found = np.random.default_rng(5), []
    target = np.nanmedian(points.reshape(-1, 3), axis=0)
    width, height = PROJECTOR
    for (right, above), own in zip(PLACES_DEG, lit, strict=False):
        a, b = np.deg2rad([right, above])
        centre = target + REACH_M * np.array([np.sin(a) * np.cos(b), -np.sin(b), -np.cos(a) * np.cos(b)])
        z = (target - centre) / np.linalg.norm(target - centre)
        x = np.cross([0.0, 1.0, 0.0], z) / np.linalg.norm(np.cross([0.0, 1.0, 0.0], z))
        local = (points - centre) @ np.stack([x, np.cross(z, x), z]).T
        px = 1.9 * width * local[..., :2] / local[..., 2:] + (0.5 * width, 0.5 * height)
        px += rng.normal(0, noise_px, px.shape)
        valid = own & np.isfinite(px).all(axis=2) & (px > 0).all(axis=2) & (px < np.array(PROJECTOR) - 1).all(axis=2)
        px[~valid] = np.nan
        found.append(Correspondence(px.astype(np.float32), valid.astype(np.float32), valid))
    return found


def points_of(*inverse_depths: Array) -> Array:
    return np.asarray(rays() / np.max(inverse_depths, axis=0)[..., None])


def everywhere(count: int) -> list[npt.NDArray[np.bool_]]:
    return [np.ones(CAMERA[::-1], np.bool_)] * count


def shape_of(stage: list[Correspondence], asked: AskedShape = "auto") -> FoundShape:
    return find_shape(asked, stage, CAMERA, [PROJECTOR] * len(stage), CameraPrior(FOCAL_PX, 0.002))


def halves() -> list[npt.NDArray[np.bool_]]:
    left = np.arange(CAMERA[0]) < CAMERA[0] // 2
    return [np.broadcast_to(side, CAMERA[::-1]) for side in (left, ~left)]


CASES: dict[str, Callable[[], list[Correspondence]]] = {
    "one projector": lambda: stage_of(points_of(panel((5, 12))), everywhere(1)),
    "panel": lambda: stage_of(points_of(panel((8, -6))), everywhere(2)),
    "panels of two projectors": lambda: stage_of(points_of(panel((8, -6))), halves()),
}


@pytest.mark.parametrize("case", CASES)
def test_a_stage_that_gives_no_surface_is_refused_only_where_one_is_asked_for(case: str) -> None:
    stage = CASES[case]()
    found = shape_of(stage)
    assert found.shape != "surface"
    assert found.why is not None
    with pytest.raises(CalibrationError) as refused:
        shape_of(stage, "surface")
    assert refused.value.code == found.why.code
    assert shape_of(stage, "unknown") == FoundShape("unknown", CAMERA)
