"""Quadrilateral pixels: they tile the image, cover what OpenCV says, and predict worse than metapixels."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from controller.core.arrays import FloatImage
from controller.optics.calibrate.correspondence.decode import decode
from controller.optics.calibrate.metapixels.from_phase import fit_metapixels
from controller.optics.calibrate.values import Metapixels
from controller.optics.capture.pattern_frames import frame
from controller.optics.capture.patterns import PatternKind, plan_patterns
from lab.study.experiments.quadrilateral import quadrilateral_corners, quadrilateral_weights
from tests.controller.optics.calibrate.simulator import Scene, Stage, photographed
from tests.controller.optics.transport.sparse_shares import gaussian_weights, normalised, predicted

CAMERA = (70, 90)


def bent_grid(rows: int = 18, columns: int = 24, pitch: float = 3.1) -> Metapixels:
    """Pixels on a grid that is turned, bent, and lies inside the camera's image."""
    row, column = np.mgrid[0:rows, 0:columns].astype(float)
    x = 10 + pitch * column + 0.15 * row + 0.6 * np.sin(row / 4)
    y = 8 + pitch * row - 0.1 * column + 0.5 * np.cos(column / 5)
    covariance = np.broadcast_to(np.array([1.5, 0.2, 1.3], np.float32), (rows, columns, 3)).copy()
    return Metapixels(np.stack([x, y], -1).astype(np.float32), covariance, np.ones((rows, columns), np.bool_))


def areas(quads: FloatImage) -> FloatImage:
    x, y = np.moveaxis(quads, -1, 0)
    doubled = (x * np.roll(y, -1, -1) - np.roll(x, -1, -1) * y).sum(-1)
    return np.asarray(np.abs(doubled) / 2, np.float32)


def test_quadrilaterals_tile_the_image_without_gap_or_overlap() -> None:
    pixels = bent_grid()
    weights = quadrilateral_weights(pixels, CAMERA)
    covered = np.asarray(weights.sum(axis=1)).reshape(CAMERA)
    np.testing.assert_allclose(covered[16:52, 18:72], 1, atol=1e-4)
    assert covered.max() < 1 + 1e-4
    np.testing.assert_allclose(
        np.asarray(weights.sum(axis=0)).ravel(), areas(quadrilateral_corners(pixels)).ravel(), rtol=1e-4
    )


def test_covered_areas_agree_with_opencv() -> None:
    pixels = bent_grid()
    quads = quadrilateral_corners(pixels).reshape(-1, 4, 2)
    weights = quadrilateral_weights(pixels, CAMERA).tocoo()
    picked = np.random.default_rng(0).choice(weights.nnz, 300, replace=False)
    for k in picked:
        y, x = divmod(int(weights.row[k]), CAMERA[1])
        square = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]], np.float32) + np.array(
            [x, y], np.float32
        )
        area, _ = cv2.intersectConvexConvex(quads[weights.col[k]], square)
        assert weights.data[k] == pytest.approx(area, abs=2e-3)


def test_corners_at_the_border_and_beside_holes_continue_the_pixels_slope() -> None:
    row, column = np.mgrid[0:6, 0:8].astype(np.float32)
    pixels = Metapixels(
        np.stack([5 + 3 * column + row, 4 + 2 * row], -1), np.ones((6, 8, 3), np.float32), np.ones((6, 8), np.bool_)
    )
    pixels.valid[2, 3] = False
    quads = quadrilateral_corners(pixels)
    wanted = np.array([[-2.0, -1], [1, -1], [2, 1], [-1, 1]])
    for i, j in ((0, 0), (5, 7), (2, 2), (3, 4), (1, 5)):
        np.testing.assert_allclose(quads[i, j] - pixels.centre_px[i, j], wanted, atol=1e-5)
    assert np.isnan(quads[2, 3]).all()


def test_pixels_outside_the_image_or_torn_over_a_depth_edge_cover_nothing() -> None:
    pixels = bent_grid()
    pixels.centre_px[:, 12:, 0] += 1000
    weights = quadrilateral_weights(pixels, CAMERA)
    light = np.asarray(weights.sum(axis=0)).reshape(pixels.valid.shape)
    assert not light[:, 11:].any()
    assert (light[:, :10] > 5).all()


def test_nothing_valid_covers_nothing() -> None:
    pixels = bent_grid()
    pixels.valid[:] = False
    assert quadrilateral_weights(pixels, CAMERA).nnz == 0
    assert gaussian_weights(pixels, CAMERA).nnz == 0


def test_shares_sum_to_one_where_there_are_any() -> None:
    for weights in (quadrilateral_weights(bent_grid(), CAMERA), gaussian_weights(bent_grid(), CAMERA)):
        total = np.asarray(normalised(weights).sum(axis=1)).ravel()
        lit = total > 0
        assert 0.5 < lit.mean() < 1
        np.testing.assert_allclose(total[lit], 1)


@pytest.mark.parametrize("blur_px", [0.3, 0.8])
def test_metapixels_predict_a_random_pattern_better_than_quadrilaterals(blur_px: float) -> None:
    scene = Scene(projector_blur_px=blur_px)
    plan = plan_patterns(scene.projector_px)
    correspondence = decode(photographed(scene), plan)
    pixels = fit_metapixels(photographed(scene), plan, correspondence)
    stage = Stage(scene)
    white = stage.light(np.ones((*pixels.valid.shape, 3), np.float32))
    pattern = frame(plan.of_kind(PatternKind.RANDOM)[0], plan.size_px)
    truth = stage.light(pattern)
    shape = (white.shape[0], white.shape[1])
    errors = []
    for model in (gaussian_weights, quadrilateral_weights):
        image, known = predicted(normalised(model(pixels, shape)), white, np.array(scene.mixing), pattern)
        use = correspondence.valid & known
        errors.append(float(np.sqrt(np.sum((image - truth)[use] ** 2) / np.sum(truth[use] ** 2))))
    assert errors[0] < 0.013
    assert errors[1] > 1.5 * errors[0]
