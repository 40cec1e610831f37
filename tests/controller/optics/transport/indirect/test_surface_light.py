from __future__ import annotations

import numpy as np
import pytest

from controller.core.arrays import FloatImage
from controller.optics.calibrate.values import SurfaceSpread
from controller.optics.transport.indirect.indirect_light import IndirectLight
from controller.optics.transport.indirect.surface_light import SurfaceLight
from tests.controller.optics.calibrate.photometry.test_surface_spread import diffused

SHAPE = (120, 150)


def surface(distance_px: float, share: float = 0.3, *, even: bool = False) -> SurfaceLight:
    rng = np.random.default_rng(2)
    white = np.ones((*SHAPE, 3)) if even else rng.uniform(0.2, 1.0, (*SHAPE, 3))
    lit = np.ones(SHAPE, np.bool_)
    if not even:
        lit[:20] = False
        lit[60:80, 40:60] = False
    return SurfaceLight.of(SurfaceSpread(share, distance_px, distance_px / 3), white.astype(np.float32), lit)


def random_light(seed: int) -> FloatImage:
    return np.random.default_rng(seed).uniform(0.0, 1.0, (*SHAPE, 3)).astype(np.float32)


@pytest.mark.parametrize("distance_px", [2.0, 5.0, 11.0])
def test_light_spreads_as_diffusion_says(distance_px: float) -> None:
    light = np.zeros((*SHAPE, 3), np.float32)
    light[50:70, 60:90] = 1.0
    found = surface(distance_px, even=True).forward(light)
    wanted = 0.3 * (diffused(light[..., 0], distance_px) - light[..., 0])
    np.testing.assert_allclose(found[..., 1], wanted, atol=0.012)
    assert float(found.sum()) == pytest.approx(0.0, abs=1.0)


@pytest.mark.parametrize("distance_px", [2.0, 9.0])
def test_adjoint(distance_px: float) -> None:
    made, light, image = surface(distance_px), random_light(3), random_light(4)
    one, other = (float(np.vdot(a, b)) for a, b in ((made.forward(light), image), (light, made.adjoint(image))))
    assert one == pytest.approx(other, rel=1e-4)


@pytest.mark.parametrize("distance_px", [2.0, 9.0])
def test_white_stays_white(distance_px: float) -> None:
    made = surface(distance_px)
    np.testing.assert_allclose(made.forward(made.white), 0.0, atol=2e-4)


@pytest.mark.parametrize("distance_px", [2.0, 9.0])
def test_a_target_is_taken_apart(distance_px: float) -> None:
    made = surface(distance_px)
    lit = made.white[..., 0] > 0
    nothing = np.zeros((1, 1), np.float32)
    light = IndirectLight(nothing, np.zeros((*SHAPE, 3), np.float32), lit, (1, 1), 150, surface=made)
    direct = np.where(lit[..., None], 0.5 * made.white * (0.5 + 0.5 * random_light(6)), 0).astype(np.float32)
    found = light.direct_target(direct + light.forward(direct))
    np.testing.assert_allclose(found, direct, atol=1e-3)
