"""A veil of the camera's lens is distinguished from light by way of other surfaces: judged by veils of other shapes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from controller.core.arrays import Float64
from controller.optics.calibrate.photometry.glare import veiled, veiling_glare
from controller.optics.calibrate.values import Calibration, Geometry, Pinhole
from tests.controller.optics.calibrate.photometry.spreading import by_angle
from tests.controller.optics.solve.conftest import plane_calibration

Veil = Callable[[Float64], Float64]
SHAPE = (200, 260)
PAINTS = (0.1, 0.3, 0.8)


def even_veil(light: Float64) -> Float64:
    return np.broadcast_to(light.mean(axis=(0, 1)), light.shape)


@cache
def wall() -> tuple[Float64, Geometry]:
    """A wall 2 m before the camera, and two projectors: the light that falls on it, (projectors, rows, columns)."""
    y, x = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    points = np.stack([(x - 130) / 350, (y - 100) / 350, np.ones(SHAPE)], axis=2) * 2.0
    normals = np.broadcast_to([0.0, 0.0, -1.0], points.shape)
    lenses = np.array([[-0.7, 0.0, 0.1], [0.7, -0.1, 0.0]])
    depth = 2.0 - lenses[:, 2, None, None]
    falling = depth / np.linalg.norm(points - lenses[:, None, None], axis=3) ** 3
    poses = tuple(Pinhole(np.eye(3), np.zeros(2), np.eye(3), -lens, (160, 120)) for lens in lenses)
    camera = Pinhole(np.eye(3), np.zeros(2), np.eye(3), np.zeros(3), (260, 200))
    place, slope = (image.astype(np.float32) for image in (points, normals))
    return falling, Geometry(camera, poses, place, slope, 0.1, True)


def stage(
    veil: Veil, *, glare: float, bounced: float, paints: tuple[float, ...] = PAINTS, seed: int = 0
) -> tuple[Calibration, Geometry]:
    """A painted wall in a bright room."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    paint = cv2.GaussianBlur(rng.choice(paints, (20, 26, 3)).repeat(10, axis=0).repeat(10, axis=1), (0, 0), 0.6)
    # what other surfaces throw at the wall has waves of its own, which are none of the paint's
    around = bounced * (1 + 0.5 * np.sin(x / 40) * np.cos(y / 30))[..., None] * np.array([1.2, 1.0, 0.8])
    falling, geometry = wall()
    whole = plane_calibration(camera=SHAPE, projectors=2)
    made = []
    for part, light in zip(whole.projectors, falling, strict=True):
        direct, thrown = paint * light[..., None], paint * around
        thrown = thrown + glare * veil(direct + thrown)
        direct, thrown = (one * (1 + 0.003 * rng.standard_normal(one.shape)) for one in (direct, thrown))
        made.append(replace(part, white=direct.astype(np.float32), indirect=thrown.astype(np.float32)))
    return replace(whole, projectors=tuple(made), object_mask=np.ones(SHAPE, np.bool_)), geometry


@pytest.mark.parametrize("veil", [even_veil, by_angle], ids=["even", "by angle"])
@pytest.mark.parametrize("glare", [0.02, 0.04])
@pytest.mark.parametrize("bounced", [0.005, 0.08], ids=["dark room", "bright room"])
def test_the_veil_is_measured(veil: Veil, glare: float, bounced: float) -> None:
    found = veiling_glare(*stage(veil, glare=glare, bounced=bounced))
    assert found == pytest.approx(glare, rel=0.4)
    said = veiled(found)
    assert said is not None
    assert f"{100 * found:.1f} %" in said


@pytest.mark.parametrize("bounced", [0.0, 0.005, 0.02, 0.08])
@pytest.mark.parametrize("seed", [0, 1])
def test_light_by_way_of_other_surfaces_is_no_veil(bounced: float, seed: int) -> None:
    assert veiled(veiling_glare(*stage(even_veil, glare=0.0, bounced=bounced, seed=seed))) is None


def test_nothing_is_said_where_too_little_is_known() -> None:
    known, geometry = stage(even_veil, glare=0.04, bounced=0.02)
    without = tuple(replace(part, indirect=None) for part in known.projectors)
    assert veiling_glare(replace(known, projectors=without), geometry) == 0
    assert veiling_glare(known, None) == 0
    assert veiling_glare(*stage(even_veil, glare=0.04, bounced=0.02, paints=(0.5,))) == 0
