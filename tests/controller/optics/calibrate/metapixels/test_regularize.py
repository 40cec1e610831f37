from __future__ import annotations

import numpy as np
import pytest

from controller.core.arrays import Float64, Mask
from controller.optics.calibrate.metapixels.regularize import fill_holes, pop, rebuild, regularize, update
from controller.optics.calibrate.values import Metapixels
from tests.controller.optics.calibrate.simulator import Scene

TRUTH = Scene().true_centres()


def metapixels(centre: Float64, valid: Mask | None = None) -> Metapixels:
    shape = centre.shape[:2]
    covariance = np.tile(np.array([1.2, 0.1, 0.8], np.float32), (*shape, 1))
    valid = np.ones(shape, np.bool_) if valid is None else valid
    where = valid[:, :, None]
    return Metapixels(
        np.where(where, centre, np.nan).astype(np.float32),
        np.where(where, covariance, np.nan).astype(np.float32),
        valid,
    )


def rms(found: Metapixels) -> float:
    error = (found.centre_px - TRUTH)[3:-3, 3:-3][found.valid[3:-3, 3:-3]]
    return float(np.sqrt(np.mean(error**2)))


def beta(centre: Float64, row: int, column: int) -> float:
    """By the text of paper 4.2.4, for a pixel with all its neighbours."""
    around = np.delete(centre[row - 1 : row + 2, column - 1 : column + 2].reshape(9, 2), 4, axis=0)

    def regularity(at: Float64) -> float:
        distance = np.linalg.norm(around - at, axis=1)
        return float(distance.min() / distance.max())

    return regularity(around.mean(axis=0)) - regularity(centre[row, column])


def test_accurate_centres_stay_where_they_are() -> None:
    found, moves = regularize(metapixels(TRUTH))
    assert moves == 0
    np.testing.assert_array_equal(found.centre_px, TRUTH.astype(np.float32))


@pytest.mark.parametrize("noise_px", [0.1, 0.3, 0.6])
def test_noisy_centres_come_closer_to_the_truth(noise_px: float) -> None:
    random = np.random.default_rng(4)
    noisy = metapixels(TRUTH + noise_px * random.standard_normal(TRUTH.shape))
    found, _ = regularize(noisy)
    assert rms(found) < 0.6 * rms(noisy) + 0.03


def test_a_single_outlier_goes_to_its_neighbours_mean_and_nothing_else_moves() -> None:
    hurt = TRUTH.copy()
    hurt[20, 30] += [1.9, -1.1]
    found, moves = regularize(metapixels(hurt))
    mean = np.delete(TRUTH[19:22, 29:32].reshape(9, 2), 4, axis=0).mean(axis=0)
    np.testing.assert_allclose(found.centre_px[20, 30], mean, atol=1e-3)
    assert moves == 1


def test_the_pixel_with_the_largest_gain_moves_first_and_none_with_a_gain_is_left() -> None:
    random = np.random.default_rng(5)
    noisy = TRUTH[:12, :14] + 0.3 * random.standard_normal((12, 14, 2))
    expected = noisy.copy()
    while True:
        gains = {(r, c): beta(expected, r, c) for r in range(1, 11) for c in range(1, 13)}
        best = max(gains, key=lambda pixel: gains[pixel])
        if gains[best] <= 0.05:
            break
        r, c = best
        expected[r, c] = np.delete(expected[r - 1 : r + 2, c - 1 : c + 2].reshape(9, 2), 4, axis=0).mean(axis=0)
    found, _ = regularize(metapixels(noisy), jump=None)
    np.testing.assert_allclose(found.centre_px, expected, atol=2e-3)


def test_edge_and_corner_pixels_stay() -> None:
    noisy = TRUTH + 0.5 * np.random.default_rng(6).standard_normal(TRUTH.shape)
    found, _ = regularize(metapixels(noisy))
    for edge in (np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1]):
        np.testing.assert_array_equal(found.centre_px[edge], noisy.astype(np.float32)[edge])


def test_missing_neighbours_are_replaced_so_that_the_mean_stays() -> None:
    columns, rows = np.meshgrid(np.arange(20.0), np.arange(20.0))
    grid = 3 * np.stack([columns, rows], axis=-1)
    valid = np.ones((20, 20), np.bool_)
    valid[10, 11] = valid[9, 9] = valid[9, 8] = False
    hurt = grid.copy()
    hurt[10, 10] += [1.2, 0.8]
    found, moves = regularize(metapixels(hurt, valid))
    np.testing.assert_allclose(found.centre_px[10, 10], grid[10, 10], atol=1e-4)
    assert moves == 1


def test_a_depth_edge_is_not_drawn_into_the_gap() -> None:
    columns, rows = np.meshgrid(np.arange(30.0), np.arange(20.0))
    grid = 3 * np.stack([columns, rows], axis=-1)
    grid[:, 15:, 0] += 40
    hurt = grid.copy()
    hurt[10, 20] += 1.0
    found, _ = regularize(metapixels(hurt))
    np.testing.assert_allclose(found.centre_px, grid, atol=1e-3)
    assert np.max(np.abs(regularize(metapixels(hurt), jump=None)[0].centre_px - grid)) > 5


def test_small_holes_are_filled_and_the_outside_is_not() -> None:
    valid = np.ones(TRUTH.shape[:2], np.bool_)
    valid[:, :6] = False
    valid[30:33, 40:42] = False
    valid[50, 60] = False
    found = fill_holes(metapixels(TRUTH, valid))
    assert found.valid[30:33, 40:42].all()
    assert found.valid[50, 60]
    assert not found.valid[:, :6].any()
    hole = ~valid & found.valid
    assert np.max(np.abs((found.centre_px - TRUTH)[hole])) < 0.1
    np.testing.assert_allclose(found.covariance_px2[hole], np.broadcast_to([1.2, 0.1, 0.8], (hole.sum(), 3)), rtol=1e-5)


def test_wide_gaps_and_gaps_between_surfaces_stay_open() -> None:
    valid = np.ones(TRUTH.shape[:2], np.bool_)
    valid[20:40, 30:60] = False
    assert not fill_holes(metapixels(TRUTH, valid)).valid[26:34, 36:54].any()
    split = TRUTH.copy()
    split[:, 50:, 0] += 60
    valid = np.ones(TRUTH.shape[:2], np.bool_)
    valid[:, 50] = False
    assert not fill_holes(metapixels(split, valid)).valid[:, 50].any()


def test_nothing_valid_is_no_error() -> None:
    nothing = metapixels(TRUTH, np.zeros(TRUTH.shape[:2], np.bool_))
    assert regularize(nothing)[1] == 0
    assert not fill_holes(nothing).valid.any()


def test_the_heap_gives_changed_keys_in_falling_order() -> None:
    random = np.random.default_rng(7)
    key = random.random(200)
    key[::7] = -np.inf
    heap, place = rebuild(key)
    for item in random.integers(0, 200, 300):
        key[item] = random.random()
        update(heap, place, key, int(item))
    left = [key[pop(heap, place, key)] for _ in range(int(heap[0]))]
    assert left == sorted(left, reverse=True)
    assert len(left) == np.count_nonzero(np.isfinite(key))
