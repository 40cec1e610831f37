"""Light that spreads below a surface: against the formula on a plane, and its laws."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import k0

from lab.emulated import subsurface
from lab.emulated.subsurface import Spread

SIDE = 121


def plane(step_m: float = 5e-4, slant: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    y, x = np.mgrid[0:SIDE, 0:SIDE]
    points = np.stack([x * step_m, y * step_m * slant, y * 0.3 * step_m], axis=-1).reshape(-1, 3)
    return np.arange(SIDE * SIDE, dtype=np.int32), points.astype(np.float32)


@pytest.mark.parametrize("slant", [1.0, 2.0])
@pytest.mark.parametrize("spread_m", [2.5e-3, 6e-3])
def test_a_point_of_light_spreads_by_k0(spread_m: float, slant: float) -> None:
    pixels, points = plane(slant=slant)
    spread = Spread.over(pixels, points, SIDE, spread_m)
    falling = np.zeros((SIDE * SIDE, 3), np.float32)
    middle = SIDE * SIDE // 2
    falling[middle] = 1.0
    found = spread.of(falling)[:, 1]
    away = np.linalg.norm(points - points[middle], axis=1)
    some = (away > 3e-3) & (away < 9e-3)
    wanted = spread.areas[middle] * k0(away[some] / spread_m) / (2 * np.pi * spread_m**2)
    np.testing.assert_allclose(found[some], wanted, rtol=0.05)


def test_light_sought_at_fewer_places_is_nearly_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    pixels, points = plane()
    points[:, 2] += 0.004 * np.sin(points[:, 0] * 300)
    falling = np.repeat(((pixels // 9 + pixels // SIDE // 11) % 2).astype(np.float32)[:, None], 3, axis=1)
    fewer = Spread.over(pixels, points, SIDE, 6e-3)
    monkeypatch.setattr(subsurface, "FINEST", np.inf)
    every = Spread.over(pixels, points, SIDE, 6e-3)
    assert fewer.between.shape[1] < 0.5 * every.between.shape[1]
    apart = fewer.of(falling) - every.of(falling)
    assert np.sqrt(np.mean(apart**2)) < 0.01
    assert np.abs(apart).max() < 0.05


@pytest.mark.parametrize("spread_m", [2e-3, 6e-3])
def test_no_light_is_lost_and_none_passes_a_depth_edge(spread_m: float) -> None:
    pixels, points = plane()
    behind = (pixels % SIDE) > 60
    points[behind, 2] += 0.1
    spread = Spread.over(pixels, points, SIDE, spread_m)
    falling = np.random.default_rng(2).random((SIDE * SIDE, 3)).astype(np.float32)
    falling[behind] = 0.0
    found = spread.of(falling)
    assert not found[behind].any()
    sums = [(spread.areas[:, None] * light).sum(axis=0) for light in (falling, found)]
    np.testing.assert_allclose(sums[0], sums[1], rtol=1e-4)
    assert found.min() > -1e-4
