"""Form factors of blocks, against a sum over all pixels and against a formula."""

from __future__ import annotations

import numpy as np
import pytest

from controller.core.arrays import Float64, FloatImage
from controller.optics.transport.indirect.form_factors import form_factors

SHAPE, GRID, SIDE = (48, 72), (4, 6), 12


def rays() -> Float64:
    y, x = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    return np.stack([(x - SHAPE[1] / 2) / 80, (y - SHAPE[0] / 2) / 80, np.ones(SHAPE)], axis=2)


Plane = tuple[tuple[float, float, float], tuple[float, float, float]]
"""A point and the normal."""
BEHIND: Plane = (0.0, 0.0, 2.268), (0.0, 0.0, -1.0)
SHELF: Plane = (0.0, 0.3, 2.0), (0.0, -0.9, -0.4359)
BEFORE: Plane = (0.0, 0.0, 2.0), (0.0, 0.0, -1.0)


def surfaces(*bands: tuple[int, Plane]) -> tuple[FloatImage, FloatImage]:
    """Points and normals; each band of rows, which begins at a row, shows a plane."""
    ray, points, normals = rays(), np.zeros((*SHAPE, 3)), np.zeros((*SHAPE, 3))
    for first, (at, normal) in bands:
        depth = np.dot(at, normal) / (ray[first:] @ np.array(normal))
        points[first:], normals[first:] = ray[first:] * depth[..., None], normal
    return points.astype(np.float32), normals.astype(np.float32)


def by_pixels(points: FloatImage, normals: FloatImage) -> Float64:
    """The mean that each block's pixels receive from all pixels of another, one by one."""
    p, n = (image.reshape(-1, 3).astype(np.float64) for image in (points, normals))
    cosine = np.maximum(np.abs(np.sum(n * p, axis=1)) / np.linalg.norm(p, axis=1), 0.1)
    area = (1 / 80) ** 2 * p[:, 2] ** 3 / np.linalg.norm(p, axis=1) / cosine
    row, column = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]] // SIDE
    block = (row * GRID[1] + column).ravel()
    out = np.zeros((GRID[0] * GRID[1],) * 2)
    for i in range(len(p)):
        apart = p - p[i]
        square = np.maximum(np.sum(apart * apart, axis=1), 1e-12)
        given = np.maximum(apart @ n[i], 0) * np.maximum(-np.sum(apart * n, axis=1), 0) / square
        given *= area / (np.pi * square + area)
        out[block[i]] += np.bincount(block, given, len(out)) / SIDE**2
    return out


CREASE = (0, BEHIND), (30, SHELF)
STEP = (0, BEHIND), (30, SHELF), (36, BEFORE)
"""A shelf that is half a block high in the picture."""


@pytest.mark.parametrize("bands", [CREASE, STEP], ids=["crease", "step"])
def test_patches_give_what_all_pixels_give(bands: tuple[tuple[int, Plane], ...]) -> None:
    points, normals = surfaces(*bands)
    wanted = by_pixels(points, normals)
    found = form_factors(points, normals, GRID, SIDE)
    assert wanted.sum() > 0.5
    # most of it is between the two sides of the crease; blocks without patches give 0.92 and a third of the light
    assert np.sqrt(np.mean((found - wanted) ** 2)) < 0.4 * np.sqrt(np.mean(wanted**2))
    assert found.sum() == pytest.approx(wanted.sum(), rel=0.25)


def test_what_has_no_shape_receives_like_its_neighbour_and_gives_nothing() -> None:
    points, normals = surfaces(*CREASE)
    points[:, 48:] = np.nan
    found = form_factors(points, normals, GRID, SIDE).reshape(*GRID, *GRID)
    # half a block is still taken for a part of the surface beside it
    np.testing.assert_array_equal(found[:, 5], found[:, 4])
    np.testing.assert_array_equal(found[..., 5], 0)


def test_gaps_of_less_than_a_block_are_closed() -> None:
    points, normals = surfaces(*CREASE)
    whole = form_factors(points, normals, GRID, SIDE)
    points[:, 20:28] = np.nan
    np.testing.assert_allclose(form_factors(points, normals, GRID, SIDE).sum(), whole.sum(), rtol=0.03)


def test_without_any_shape_nothing_is_given() -> None:
    nothing = np.full((*SHAPE, 3), np.nan, np.float32)
    np.testing.assert_array_equal(form_factors(nothing, nothing, GRID, SIDE), 0)


def walls() -> tuple[FloatImage, FloatImage]:
    """Points and normals of a wall behind two that stand before it and face each other."""
    ray = rays()
    points, normals = ray * 2.4, np.broadcast_to((0.0, 0.0, -1.0), ray.shape).copy()
    for at, inwards in ((-0.6, 1.0), (0.4, -1.0)):
        depth = at / np.where(ray[..., 0] * at > 0, ray[..., 0], np.nan)
        here = (depth > 1.6) & (depth < 2.4)
        points[here], normals[here] = ray[here] * depth[here, None], (inwards, 0.0, 0.0)
    return points.astype(np.float32), normals.astype(np.float32)


def test_what_is_hidden_gives_nothing() -> None:
    points, normals = walls()
    found = form_factors(points, normals, GRID, SIDE).reshape(*GRID, *GRID)
    x = points[..., 0].reshape(GRID[0], SIDE, GRID[1], SIDE).mean(axis=(0, 1, 3))
    beyond, left = int(np.argmax(x)), int(np.argmin(np.abs(x + 0.6)))
    assert x[beyond] > 0.6
    np.testing.assert_array_equal(found[:, left, :, beyond], 0)
    # in front of it nothing is
    unhidden = by_pixels(points, normals).reshape(found.shape)
    assert unhidden[:, left, :, beyond].sum() > 0.01
    assert found[:, left].sum() == pytest.approx(unhidden[:, left, :, :beyond].sum(), rel=0.1)
