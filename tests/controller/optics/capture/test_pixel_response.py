"""Pixels that differ in their response are not confused with paint, noise, or the gaps between a projector's pixels."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from controller.core.arrays import Float64, FloatImage
from controller.core.errors import TroubleCode
from controller.optics.capture.linearity import NAMED_SPREAD, camera_faults
from controller.optics.capture.pixel_response import ENOUGH_SAMPLES, response_spread, some_rows

SHAPE = (360, 480)
RGGB = np.array([[0, 1], [1, 2]])
FINE, LENS_PX = 3, 0.5
"""Points of paint along a pixel, and the lens' blur in pixels."""
GAPS = 0.008
"""What both lenses leave of gaps that take a tenth of a projector's pixel."""
ELECTRONS = 36_000
EXPOSURES = (0.3, 1.0, 3.0)


def paint(rng: np.random.Generator, rough: float) -> Float64:
    """Patches with sharp edges, on half of the picture with grain as fine as pixels; through a lens."""
    rows, columns = (FINE * size for size in SHAPE)
    patches = rng.uniform(0.15, 0.8, (6, 8, 3)).repeat(rows // 6, axis=0).repeat(columns // 8, axis=1)
    grain = rough * rng.standard_normal((rows, columns, 3))
    grain[:, : columns // 2] = 0
    seen = cv2.GaussianBlur(patches * (1 + grain), (0, 0), FINE * LENS_PX)
    return np.asarray(seen.reshape(SHAPE[0], FINE, SHAPE[1], FINE, 3).mean(axis=(1, 3)), np.float64)


def whites(
    spread: float, *, seed: int = 0, projectors: int = 3, rough: float = 0.3, only_rough: bool = False
) -> list[list[FloatImage]]:
    """Photographs of each projector's white: its pixels lie on a grid of their own, with gaps."""
    rng = np.random.default_rng(seed)
    painted = paint(rng, rough)
    if only_rough:
        painted = np.concatenate([painted[:, SHAPE[1] // 2 :]] * 2, axis=1)
    response = 1 + spread * rng.standard_normal(SHAPE)
    y, x = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    found = []
    for _ in range(projectors):
        pitch, (right, down) = rng.uniform(2.5, 3.2), rng.uniform(0, 3, 2)
        gaps = 1 + GAPS * (np.cos(2 * np.pi * (x + right) / pitch) + np.cos(2 * np.pi * (y + down) / pitch))
        light = painted * (gaps * (0.6 + 0.4 * np.sin(x / 200 + right)))[..., None]
        samples = np.empty(SHAPE)
        for row, column in np.ndindex(2, 2):
            samples[row::2, column::2] = light[row::2, column::2, RGGB[row, column]]
        found.append([_exposed(samples * response, exposure, rng) for exposure in EXPOSURES])
    return found


def _exposed(samples: Float64, exposure: float, rng: np.random.Generator) -> FloatImage:
    electrons = ELECTRONS * exposure * samples
    electrons += rng.standard_normal(SHAPE) * np.sqrt(electrons + 81)
    return np.where(electrons < ELECTRONS, electrons / ELECTRONS, np.nan).astype(np.float32)


@pytest.mark.parametrize("spread", [0.005, 0.01, 0.02])
@pytest.mark.parametrize("seed", [0, 1])
def test_the_spread_is_measured(spread: float, seed: int) -> None:
    found = response_spread(whites(spread, seed=seed), RGGB)
    assert found == pytest.approx(spread, rel=0.15)
    said = camera_faults(np.empty((0, 2)), 0, 1000, found)
    assert f"{100 * found:.1f} %" in said[TroubleCode.PIXEL_RESPONSE]


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("only_rough", [False, True])
def test_an_even_sensor_has_none_whatever_the_paint(seed: int, only_rough: bool) -> None:
    found = response_spread(whites(0.0, seed=seed, only_rough=only_rough), RGGB)
    assert found < NAMED_SPREAD
    assert not camera_faults(np.empty((0, 2)), 0, 1000, found)


def test_some_rows_stand_for_a_large_picture() -> None:
    large = [[np.tile(one, (6, 3)) for one in exposures] for exposures in whites(0.01)]
    few = [[some_rows(one) for one in exposures] for exposures in large]
    assert few[0][0].size < 1.2 * ENOUGH_SAMPLES < large[0][0].size
    assert few[0][0].shape[0] % 2 == 0
    assert response_spread(few, RGGB) == pytest.approx(0.01, rel=0.15)
    small = large[0][0][:300, :400]
    assert some_rows(small) is small


def test_one_projector_does_not_tell() -> None:
    assert response_spread(whites(0.02, projectors=1), RGGB) == 0
    assert response_spread([], RGGB) == 0
    assert response_spread([[np.full(SHAPE, np.nan, np.float32)]] * 2, RGGB) == 0
