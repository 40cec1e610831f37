"""A small calibrated stage to export: a tilted wall before a bent lens, and two projectors with lens shift."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from controller.core.arrays import FloatImage
from controller.optics.calibrate.values import Geometry, Metapixels, Pinhole
from controller.optics.transport import LightTransport, build_transport
from controller.stage.exchange.content import Content
from tests.controller.optics.calibrate.mesh.test_export import SIZE, stage
from tests.controller.optics.solve.conftest import plane_calibration

NAMES = ("left", 'upper "right" ä')
NOISE_PX = 0.2


def two_projectors() -> Geometry:
    """The wall of the mesh's tests, all of it before two projectors, of which one has a lens of its own."""
    one = stage()
    first = replace(
        one.projectors[0], matrix=np.array([[90.0, 0, -25.0], [0, 90.0, 23.0], [0, 0, 1]]), size_px=(70, 44)
    )
    turn = cv2.Rodrigues(np.array([-0.05, -0.3, 0.1]))[0].astype(np.float64)
    matrix = np.array([[300.0, 0, 285.0], [0, 302.0, 70.0], [0, 0, 1]])
    second = Pinhole(matrix, np.array([-0.05, 0.01, 0.004, -0.003]), turn, np.array([-0.3, 0.0, 0.05]), (210, 150))
    return replace(one, projectors=(first, second))


def opencv_px(own: Pinhole, points_m: FloatImage) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """What OpenCV says of (points, 3): it shares no code with ours."""
    px, _ = cv2.projectPoints(
        points_m.astype(np.float64), cv2.Rodrigues(own.rotation)[0], own.translation_m, own.matrix, own.distortion
    )
    return np.asarray(px[:, 0], np.float64)


def opencv_bent(own: Pinhole, ray: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> FloatImage:
    """Where OpenCV puts (..., 2) x, y at depth 1."""
    points = np.concatenate([ray, np.ones((*ray.shape[:-1], 1))], axis=-1).reshape(-1, 3)
    px, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), own.matrix, own.distortion)
    return np.asarray(px.reshape(ray.shape))


@pytest.fixture(scope="module")
def transport() -> LightTransport:
    return build_transport(plane_calibration(camera=(SIZE[1], SIZE[0])))


@pytest.fixture(scope="module")
def content(transport: LightTransport) -> Content:
    geometry = two_projectors()
    random = np.random.default_rng(4)
    seen: list[FloatImage] = []
    for own in geometry.projectors:
        px = opencv_px(own, geometry.points_m.reshape(-1, 3)).reshape(SIZE[1], SIZE[0], 2)
        px += random.normal(0, NOISE_PX, px.shape)
        px[random.random(px.shape[:2]) < 0.3] = np.nan
        seen.append(px.astype(np.float32))
    metapixels = []
    for own in geometry.projectors:
        centre = random.uniform((0, 0), SIZE, (own.size_px[1], own.size_px[0], 2)).astype(np.float32)
        valid = random.random(centre.shape[:2]) > 0.2
        metapixels.append(Metapixels(centre, np.ones((*valid.shape, 3), np.float32), valid))
    return Content(
        folder=Path("unused"),
        shape=geometry,
        names=NAMES,
        step=1,
        picture=random.integers(0, 256, (SIZE[1], SIZE[0], 3), dtype=np.uint8),
        seen_px=tuple(seen),
        metapixels=lambda: tuple(metapixels),
        transport=lambda: transport,
        black=lambda: np.full((SIZE[1], SIZE[0], 3), 0.002, np.float32),
    )
