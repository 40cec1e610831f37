"""Gloss differs from paint by what a surface mirrors of one projector alone: judged by lobes of other kinds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from controller.core.arrays import Float64
from controller.optics.calibrate.photometry.reflectance import gloss_strength, glossy
from controller.optics.calibrate.values import Calibration, Geometry, Pinhole
from tests.controller.optics.solve.conftest import plane_calibration

Lobe = Callable[[Float64, Float64, Float64], Float64]
"""(n.h, n.l, n.v), each (rows, columns): what a highlight adds to a white albedo."""
SHAPE = (120, 160)
LENSES = np.array([[-0.7, 0.0, 0.1], [0.7, -0.1, 0.0], [0.1, -0.8, 0.2]])


def matt(half: Float64, light: Float64, eye: Float64) -> Float64:
    return np.zeros_like(half)


def blinn(strength: float, exponent: float) -> Lobe:
    return lambda half, light, eye: strength * (exponent + 8) / 8 * half**exponent


def ggx(roughness: float) -> Lobe:
    """A varnish by Walter et al. 2007 with Schlick's factor; pi times it is what adds to the albedo."""

    def lobe(half: Float64, light: Float64, eye: Float64) -> Float64:
        square = roughness**4
        density = square / (np.pi * (half**2 * (square - 1) + 1) ** 2)
        seen = 2 * light * eye / (light * np.sqrt(square + (1 - square) * eye**2) + 1e-9 + eye)
        return np.asarray(np.pi * 0.04 * density * seen / np.maximum(4 * light * eye, 1e-3))

    return lobe


def ball(lobe: Lobe, *, seed: int = 0, noise: float = 0.005, tilt: float = 0.01) -> tuple[Calibration, Geometry]:
    """A painted ball of 0.3 m, 2 m before the camera, and three projectors; normals are off by ``tilt`` radians."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    ray = np.stack([(x - 80) / 350, (y - 60) / 350, np.ones(SHAPE)], axis=2)
    ray /= np.linalg.norm(ray, axis=2, keepdims=True)
    centre = np.array([0, 0, 2.0])
    along = ray @ centre
    inside = along**2 - centre @ centre + 0.3**2
    on = inside > 0
    points = ray * (along - np.sqrt(np.maximum(inside, 0)))[..., None]
    normals = (points - centre) / 0.3
    paint = 0.2 + 0.6 * rng.random((12, 16, 3)).repeat(10, axis=0).repeat(10, axis=1)
    eye = -np.sum(normals * ray, axis=2)
    whites = []
    for n, lens in enumerate(LENSES):
        towards = lens - points
        distance = np.linalg.norm(towards, axis=2)
        towards /= distance[..., None]
        between = towards - ray
        between /= np.linalg.norm(between, axis=2, keepdims=True)
        light = np.clip(np.sum(towards * normals, axis=2), 0, 1)
        half = np.clip(np.sum(between * normals, axis=2), 0, 1)
        seen = (paint + lobe(half, light, eye)[..., None]) * (light / distance**2 * (1 + 0.3 * n))[..., None]
        whites.append(np.where(on[..., None], seen * (1 + noise * rng.normal(size=seen.shape)), 0).astype(np.float32))
    stage = plane_calibration(camera=SHAPE, projectors=3)
    parts = tuple(replace(part, white=white) for part, white in zip(stage.projectors, whites, strict=True))
    known = normals + tilt * rng.normal(size=normals.shape)
    known /= np.linalg.norm(known, axis=2, keepdims=True)
    place, slope = (np.where(on[..., None], image, np.nan).astype(np.float32) for image in (points, known))
    poses = tuple(Pinhole(np.eye(3), np.zeros(2), np.eye(3), -lens, (160, 120)) for lens in LENSES)
    camera = Pinhole(np.eye(3), np.zeros(2), np.eye(3), np.zeros(3), (160, 120))
    return replace(stage, projectors=parts, object_mask=on), Geometry(camera, poses, place, slope, 0.1, True)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_paint_alone_is_matt(seed: int) -> None:
    assert glossy(gloss_strength(*ball(matt, seed=seed))) is None


@pytest.mark.parametrize("strength", [0.02, 0.04, 0.1])
def test_a_highlight_of_that_kind_is_measured(strength: float) -> None:
    assert gloss_strength(*ball(blinn(strength, 25))) == pytest.approx(strength, rel=0.35)


@pytest.mark.parametrize("lobe", [blinn(0.04, 10), blinn(0.04, 100), ggx(0.45)], ids=["broad", "narrow", "varnish"])
def test_other_highlights_are_named_too(lobe: Lobe) -> None:
    said = glossy(gloss_strength(*ball(lobe)))
    assert said is not None
    assert "glossy" in said


def test_nothing_is_said_where_too_little_is_known() -> None:
    stage, geometry = ball(blinn(0.1, 25))
    assert gloss_strength(stage, None) == 0
    assert gloss_strength(replace(stage, projectors=stage.projectors[:1]), geometry) == 0
    assert gloss_strength(replace(stage, object_mask=np.zeros(SHAPE, np.bool_)), geometry) == 0
