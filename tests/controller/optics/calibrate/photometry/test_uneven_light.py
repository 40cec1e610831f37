"""The part of tiles' residuals that neighbours share, against the Gaussian process written out as matrices."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import solve

from controller.core.arrays import Float64
from controller.optics.calibrate.photometry.colour_tiles import TileMeasurements
from controller.optics.calibrate.photometry.tile_fit import ALIKE_TILES, OWN, UNEVEN, uneven_light


@pytest.mark.parametrize(("rows", "columns", "seed"), [(1, 1, 0), (1, 40, 1), (14, 18, 2), (30, 25, 3)])
def test_it_is_the_mean_of_the_gaussian_process(rows: int, columns: int, seed: int) -> None:
    tiles, residual, weight = drawn(rows, columns, seed)
    found = uneven_light(tiles, residual, weight)
    for photograph in (0, 1):
        own = tiles.photograph == photograph
        for channel in range(3):
            expected = written_out(
                tiles.place[own], tiles.indirect[own, channel], residual[own, channel], 1 / weight[own, channel]
            )
            assert np.abs(found[own, channel] - expected).max(initial=0) <= 1e-5 * np.abs(residual).max()


def test_what_does_not_count_is_told_by_its_neighbours() -> None:
    tiles, _, weight = drawn(20, 20, 4)
    smooth = np.sin(tiles.place / 6).sum(axis=1, keepdims=True) * 0.01 * np.ones(3)
    wrong = smooth.copy()
    wrong[::7] += 0.1
    counted = weight.copy()
    counted[::7] = 0.0
    right, found, fooled = (
        uneven_light(tiles, *given) for given in ((smooth, weight), (wrong, counted), (wrong, weight))
    )
    assert np.sqrt(np.mean((found - right) ** 2)) < 0.2 * np.sqrt(np.mean((fooled - right) ** 2))


def drawn(rows: int, columns: int, seed: int) -> tuple[TileMeasurements, Float64, Float64]:
    """Two photographs of a grid that lacks every fifth tile, with much and with little indirect light."""
    random = np.random.default_rng(seed)
    row, column = np.divmod(np.arange(rows * columns), columns)
    kept = [np.flatnonzero(random.random(rows * columns) > 0.2 * (rows * columns > 1)) for _ in range(2)]
    place = np.concatenate([np.stack([column[k], row[k]], axis=1) for k in kept])
    shape = (len(place), 3)
    indirect = random.uniform(0, 0.2, shape)
    weight = 1 / (1e-6 + (OWN * indirect) ** 2)
    photograph = np.repeat([0, 1], [len(k) for k in kept])
    tiles = TileMeasurements(
        random.integers(0, 256, shape), random.random(shape), weight, photograph, 2, indirect, place, np.ones(shape)
    )
    return tiles, 0.02 * random.standard_normal(shape), weight * random.uniform(0.01, 1, shape)


def written_out(place: Float64, indirect: Float64, residual: Float64, variance: Float64) -> Float64:
    apart = ((place[:, None] - place[None]) ** 2).sum(axis=2)
    shared = np.exp(-apart / (2 * ALIKE_TILES**2)) * UNEVEN * indirect[:, None] * UNEVEN * indirect
    return np.asarray(shared @ solve(shared + np.diag(variance), residual, assume_a="pos"))
