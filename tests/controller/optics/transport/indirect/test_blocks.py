"""Blocks of a picture, against OpenCV, and each with its transpose."""

from __future__ import annotations

import cv2
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from controller.optics.transport.indirect.blocks import down, down_adjoint, up, up_adjoint

sizes = st.tuples(st.integers(1, 60), st.integers(1, 60), st.integers(1, 17), st.integers(0, 99))


@given(sizes)
def test_a_block_is_the_mean_of_its_pixels_and_beyond_the_picture_there_is_none(
    case: tuple[int, int, int, int],
) -> None:
    rows, columns, side, seed = case
    image = np.random.default_rng(seed).random((rows, columns, 3), dtype=np.float32)
    grid = -(-rows // side), -(-columns // side)
    whole = cv2.copyMakeBorder(image, 0, grid[0] * side - rows, 0, grid[1] * side - columns, cv2.BORDER_CONSTANT)
    expected = cv2.resize(whole.astype(np.float64), grid[::-1], interpolation=cv2.INTER_AREA)
    np.testing.assert_allclose(down(image, grid, side), expected.reshape(-1, 3), atol=1e-6)


@given(sizes)
def test_blocks_are_interpolated_as_opencv_enlarges(case: tuple[int, int, int, int]) -> None:
    rows, columns, side, seed = case
    grid = -(-rows // side), -(-columns // side)
    blocks = np.random.default_rng(seed).random((grid[0] * grid[1], 3), dtype=np.float32)
    whole = cv2.resize(
        blocks.reshape(*grid, 3), (grid[1] * side, grid[0] * side), interpolation=cv2.INTER_LINEAR
    ).reshape(grid[0] * side, grid[1] * side, 3)
    np.testing.assert_allclose(up(blocks, grid, side, (rows, columns, 3)), whole[:rows, :columns], atol=1e-6)


@given(sizes)
def test_transposes_are_transposes(case: tuple[int, int, int, int]) -> None:
    rows, columns, side, seed = case
    rng = np.random.default_rng(seed)
    grid, shape = (-(-rows // side), -(-columns // side)), (rows, columns, 3)
    image, blocks = rng.random(shape, dtype=np.float32), rng.random((grid[0] * grid[1], 3), dtype=np.float32)
    for one, other in (
        (down(image, grid, side) * blocks, image * down_adjoint(blocks, grid, side, shape)),
        (up(blocks, grid, side, shape) * image, blocks * up_adjoint(image, grid, side)),
    ):
        np.testing.assert_allclose(one.sum(dtype=np.float64), other.sum(dtype=np.float64), rtol=1e-4)
