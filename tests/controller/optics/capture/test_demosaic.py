from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from controller.core.arrays import Float64
from controller.optics.capture.demosaic import WORTH_THREADS, SensorLevels, bayer_kernels, demosaic, fill_bad

ORDERS = {"RGGB": [[0, 1], [1, 2]], "BGGR": [[2, 1], [1, 0]], "GRBG": [[1, 0], [2, 1]], "GBRG": [[1, 2], [0, 1]]}
CODES = {
    "RGGB": cv2.COLOR_BayerRGGB2RGB,
    "BGGR": cv2.COLOR_BayerBGGR2RGB,
    "GRBG": cv2.COLOR_BayerGRBG2RGB,
    "GBRG": cv2.COLOR_BayerGBRG2RGB,
}


def levels_of(order: str, *, black: float = 0.0, white: float = 4000.0, clip: float = np.inf) -> SensorLevels:
    flat = (np.full((2, 2), value) for value in (black, white, clip))
    return SensorLevels(np.array(ORDERS[order]), *flat)


def random_mosaic(rows: int = 23, columns: int = 31) -> npt.NDArray[np.uint16]:
    return np.random.default_rng(0).integers(0, 4096, (rows, columns)).astype(np.uint16)


def by_kernels(value: Float64, kernels: Float64) -> Float64:
    """Every inner pixel as the published kernels say, without the code under test."""
    rows, columns = value.shape
    image = np.zeros((rows, columns, 3))
    for row in range(1, rows - 1):
        for column in range(1, columns - 1):
            near = value[row - 1 : row + 2, column - 1 : column + 2]
            image[row, column] = np.sum(kernels[row & 1, column & 1] * near, axis=(1, 2))
    return image


@pytest.mark.parametrize("order", ORDERS)
def test_the_image_is_what_the_told_kernels_make_of_the_samples(order: str) -> None:
    mosaic = random_mosaic()
    kernels = bayer_kernels(np.array(ORDERS[order]))
    np.testing.assert_allclose(kernels.sum(axis=(3, 4)), 1)
    image, _ = demosaic(mosaic, levels_of(order))
    expected = by_kernels(mosaic / 4000.0, kernels)
    np.testing.assert_allclose(image[1:-1, 1:-1], expected[1:-1, 1:-1], atol=1e-6)


@pytest.mark.parametrize("order", ORDERS)
def test_opencv_interpolates_the_same_but_for_its_rounding_to_whole_steps(order: str) -> None:
    mosaic = random_mosaic(40, 52)
    image, _ = demosaic(mosaic, levels_of(order, white=1.0))
    theirs = cv2.cvtColor(mosaic, CODES[order]).astype(np.float64)
    assert np.abs(image - theirs)[1:-1, 1:-1].max() <= 0.5001


def test_levels_that_differ_between_the_sites_are_taken_off_before_colours_are_mixed() -> None:
    light = np.random.default_rng(1).random((16, 18))
    black = np.array([[100.0, 120.0], [140.0, 90.0]])
    white = np.array([[3000.0, 3500.0], [3900.0, 3200.0]])
    tiled = [np.tile(level, (8, 9)) for level in (black, white)]
    mosaic = np.round(tiled[0] + light * (tiled[1] - tiled[0])).astype(np.uint16)
    colours = np.array(ORDERS["RGGB"])
    image, _ = demosaic(mosaic, SensorLevels(colours, black, white, np.full((2, 2), np.inf)))
    np.testing.assert_allclose(image[1:-1, 1:-1], by_kernels(light, bayer_kernels(colours))[1:-1, 1:-1], atol=3e-4)


def test_a_flat_field_is_flat_to_its_very_edge_and_the_gain_scales_it() -> None:
    image, saturated = demosaic(np.full((9, 7), 1100, np.uint16), levels_of("GRBG", black=100.0, white=2100.0), gain=4)
    np.testing.assert_allclose(image, 2.0)
    assert not saturated.any()


@pytest.mark.parametrize("at", [(0, 0), (4, 6), (8, 3), (8, 10)])
def test_a_clipped_sample_marks_its_neighbours_and_nobody_else(at: tuple[int, int]) -> None:
    mosaic = np.full((9, 11), 1000, np.uint16)
    mosaic[at] = 3900
    _, saturated = demosaic(mosaic, levels_of("RGGB", clip=3899.5))
    expected = np.zeros((9, 11), np.bool_)
    expected[max(at[0] - 1, 0) : at[0] + 2, max(at[1] - 1, 0) : at[1] + 2] = True
    np.testing.assert_array_equal(saturated, expected)


def test_bad_samples_are_filled_from_good_ones_of_their_own_colour() -> None:
    site = np.tile([[100, 200], [200, 400]], (6, 6)).astype(np.uint16)
    broken = site.copy()
    bad = np.array([[0, 0], [5, 4], [7, 4], [11, 11]])
    broken[bad[:, 1], bad[:, 0]] = 4095
    np.testing.assert_array_equal(fill_bad(broken, np.vstack((bad, [[40, 40], [-1, 3]]))), site)
    assert broken[4, 5] == 4095


def test_an_image_made_in_strips_is_the_same_as_one_made_whole() -> None:
    mosaic = np.tile(random_mosaic(74, 128), (15, 8))
    mosaic[np.arange(0, 1100, 127), 500] = 4095
    mosaic[np.arange(0, 1100, 128), 700] = 4095
    assert mosaic.size > WORTH_THREADS
    image, saturated = demosaic(mosaic, levels_of("GBRG", clip=4095))
    rows = 0
    for first in range(0, mosaic.shape[0] - 140, 140):
        part, marked = demosaic(mosaic[first : first + 142], levels_of("GBRG", clip=4095))
        np.testing.assert_array_equal(image[first + 1 : first + 141], part[1:141])
        np.testing.assert_array_equal(saturated[first + 1 : first + 141], marked[1:141])
        rows += 140
    assert rows > 128
