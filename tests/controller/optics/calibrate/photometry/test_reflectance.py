"""The object's own pattern, without the shading of its white images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from controller.core.arrays import FloatImage
from controller.optics.calibrate.photometry.reflectance import own_reflectance
from controller.optics.calibrate.values import Geometry, Pinhole
from tests.lab.study.array_stage import CAMERA, array_subject

SUBJECT = array_subject()
GAINS = np.array([[1.0, 1.0, 1.0], [0.7, 0.8, 0.9], [1.3, 1.0, 0.8]], np.float32)


def lamps() -> Geometry:
    """The shell before three lamps, left, right and above."""
    places = [(-0.6, 0.0, 0.0), (0.6, 0.0, 0.1), (0.0, -0.7, 0.0)]
    pinholes = tuple(Pinhole(np.eye(3), np.zeros(2), np.eye(3), -np.array(place), (40, 30)) for place in places)
    return replace(SUBJECT.geometry, projectors=pinholes)


def paint() -> FloatImage:
    y, x = np.mgrid[0 : CAMERA[0], 0 : CAMERA[1]]
    red = ((y // 8 + x // 8) % 2 == 0)[..., None]
    return np.where(red, np.array([0.8, 0.3, 0.2]), np.array([0.9, 0.9, 0.9])).astype(np.float32)


def test_shape_takes_the_shading_away_and_leaves_the_paint() -> None:
    geometry, parts = lamps(), []
    for part, pinhole, gain in zip(SUBJECT.calibration.projectors, geometry.projectors, GAINS, strict=True):
        towards = -pinhole.translation_m - geometry.points_m
        distance = np.linalg.norm(towards, axis=2)
        light = np.maximum((towards * geometry.normals).sum(axis=2) / distance, 0) / distance**2
        parts.append(replace(part, white=(light[..., None] * gain * paint()).astype(np.float32)))
    calibration = replace(SUBJECT.calibration, projectors=tuple(parts))
    found = own_reflectance(calibration, geometry)
    known = np.asarray(np.isfinite(found).all(axis=2))
    assert known[calibration.object_mask].mean() > 0.95
    assert not known[~calibration.object_mask].any()
    np.testing.assert_allclose(found[known], paint()[known] / 0.9, rtol=0.02)
    shaded = own_reflectance(calibration, None)[known]
    assert np.abs(np.log(shaded / paint()[known])).std() > 5 * np.abs(np.log(found[known] / paint()[known])).std()


def test_nothing_is_known_of_an_object_without_light() -> None:
    dark = tuple(replace(part, white=np.zeros_like(part.white)) for part in SUBJECT.calibration.projectors)
    mask = np.zeros_like(SUBJECT.calibration.object_mask)
    found = own_reflectance(replace(SUBJECT.calibration, projectors=dark, object_mask=mask), lamps())
    assert np.isnan(found).all()
    assert found.shape == pytest.approx((*CAMERA, 3))
