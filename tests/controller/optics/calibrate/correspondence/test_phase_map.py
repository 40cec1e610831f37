"""The phase map as the transport wants it."""

from __future__ import annotations

import numpy as np
import pytest

from controller.optics.calibrate.correspondence.phase_map import (
    FARTHEST_PX,
    LEAST_VARIANCE_PX2,
    invert_map,
    make_phase_map,
)
from controller.optics.calibrate.correspondence.smoothing import fit_curved
from controller.optics.calibrate.values import Correspondence, PhaseMap

SIZE = (40, 30)
MATRIX = np.array([[0.4, 0.05], [-0.03, 0.5]])
"""d projector / d camera."""


def looking() -> tuple[Correspondence, np.ndarray[tuple[int, ...], np.dtype[np.float64]]]:
    """A plane, decoded but for its left 20 columns and a hole."""
    y, x = np.mgrid[0:60, 0:100].astype(np.float64)
    true = np.stack([x, y], -1) @ MATRIX.T + np.array([0.3, 1.2])
    valid = np.ones((60, 100), np.bool_)
    valid[:, :20] = False
    valid[20:26, 50:56] = False
    position = np.where(valid[..., None], true, np.nan).astype(np.float32)
    return Correspondence(position, np.where(valid, 0.9, 0).astype(np.float32), valid), true


def made(blur: float = 0.4, *, interpolated: bool = True, light: tuple[float, float, float] = (1, 1, 1)) -> PhaseMap:
    correspondence, _ = looking()
    inverse = invert_map(correspondence, SIZE)
    spread = np.broadcast_to(np.array([blur, 0, blur], np.float32), (SIZE[1], SIZE[0], 3))
    everywhere = np.ones((SIZE[1], SIZE[0]), np.bool_)
    return make_phase_map(correspondence, inverse, spread, everywhere, light=light, interpolated=interpolated)


def test_it_goes_on_along_the_plane_beyond_what_was_decoded() -> None:
    correspondence, true = looking()
    found = made().projector_px
    near = np.zeros(correspondence.valid.shape, np.bool_)
    near[:, 20 - FARTHEST_PX + 1 :] = True
    assert np.isfinite(found[near]).all()
    np.testing.assert_allclose(found[near], true[near], atol=2e-3)
    assert np.isnan(found[:, : 20 - FARTHEST_PX - 1]).all()
    np.testing.assert_array_equal(found[correspondence.valid], correspondence.projector_px[correspondence.valid])


def test_the_interpolation_of_the_colours_is_taken_from_the_blur() -> None:
    variance = 5 / 12
    taken = 0.4 * np.eye(2) - variance * MATRIX @ MATRIX.T
    xx, xy, yy = np.moveaxis(made().spread_px2, -1, 0)
    np.testing.assert_allclose(xx, taken[0, 0], atol=2e-3)
    np.testing.assert_allclose(xy, taken[0, 1], atol=2e-3)
    np.testing.assert_allclose(yy, taken[1, 1], atol=2e-3)
    green = 0.4 * np.eye(2) - MATRIX @ MATRIX.T / 4
    np.testing.assert_allclose(made(light=(0, 1, 0)).spread_px2[..., 0], green[0, 0], atol=2e-3)


def test_a_camera_that_does_not_interpolate_keeps_its_blur() -> None:
    np.testing.assert_allclose(made(interpolated=False).spread_px2[..., 0], 0.4, atol=1e-6)


@pytest.mark.parametrize("blur", [0.0, 0.01, 0.1])
def test_no_blur_is_narrower_than_a_pixel(blur: float) -> None:
    xx, xy, yy = np.moveaxis(made(blur).spread_px2.astype(np.float64), -1, 0)
    assert xx.min() >= LEAST_VARIANCE_PX2 * 0.999
    assert yy.min() >= LEAST_VARIANCE_PX2 * 0.999
    assert np.all(xx * yy > xy * xy)


def test_where_nothing_was_decoded_nothing_is_known() -> None:
    nothing = np.full((60, 100, 2), np.nan, np.float32)
    correspondence = Correspondence(nothing, np.zeros((60, 100), np.float32), np.zeros((60, 100), np.bool_))
    inverse = invert_map(correspondence, SIZE)
    blank = np.zeros((SIZE[1], SIZE[0], 3), np.float32)
    found = make_phase_map(correspondence, inverse, blank, np.zeros((SIZE[1], SIZE[0]), np.bool_))
    assert np.isnan(found.projector_px).all()
    assert np.isnan(found.spread_px2).all()


def test_a_curved_fit_is_the_least_squares_polynomial_of_each_neighbourhood() -> None:
    random = np.random.default_rng(7)
    y, x = np.mgrid[0:61, 0:40]
    smooth = np.stack([0.4 * x + np.sin(y / 9), 0.4 * y + np.cos(x / 8)], -1)
    position = (smooth + random.normal(0, 0.03, smooth.shape)).astype(np.float32)
    valid = random.random((61, 40)) > 0.02
    position[~valid] = np.nan
    otherwise = position + np.float32(1)
    found = fit_curved(position, valid, otherwise)
    fitted = 0
    for row, column in np.ndindex(57, 36):
        near = np.s_[row : row + 5, column : column + 5]
        here = row + 2, column + 2
        if valid[near].all() and (found[here] != otherwise[here]).all():
            a = np.stack([np.ones(25), *(v[near].ravel() for v in (x, y, x * x, x * y, y * y))], axis=1)
            terms = np.linalg.lstsq(a, position[near].reshape(25, 2), rcond=None)[0]
            there = np.array([1, here[1], here[0], here[1] ** 2, here[1] * here[0], here[0] ** 2])
            np.testing.assert_allclose(found[here], there @ terms, atol=2e-5)
            fitted += 1
        elif not valid[near].all():
            np.testing.assert_array_equal(found[here], otherwise[here])
    assert fitted > 300
