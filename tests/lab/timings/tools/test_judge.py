"""What judges the calibration must itself be right: moments, alignment, relative error."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lab.timings.tools.alignment import similarity
from lab.timings.tools.judge import relative, rms
from lab.timings.tools.truth import developed, moments, window_around


def test_moments_of_a_known_footprint_are_found() -> None:
    y, x = np.mgrid[0:60, 0:80].astype(np.float64)
    covariance = np.array([[3.0, 0.8], [0.8, 2.0]])
    d = np.stack([x - 41.3, y - 28.6], axis=-1)
    share = np.exp(-0.5 * np.einsum("...i,ij,...j", d, np.linalg.inv(covariance), d)).astype(np.float32)
    window = window_around(np.array([41.5, 28.4]), np.array([3.2, 0.7, 2.1]), share.shape)
    assert window is not None
    found = moments(share, window)
    assert found is not None
    np.testing.assert_allclose(found, [41.3, 28.6, 3.0, 0.8, 2.0], atol=2e-3)


def test_a_footprint_at_the_border_is_not_judged() -> None:
    round_covariance = np.array([4.0, 0.0, 4.0])
    assert window_around(np.array([5.0, 30.0]), round_covariance, (60, 80)) is None
    inside = window_around(np.array([40.0, 30.0]), round_covariance, (60, 80))
    assert inside is not None
    assert moments(np.zeros((60, 80), np.float32), inside) is None


def test_light_beside_the_footprint_does_not_count() -> None:
    y, x = np.mgrid[0:60, 0:80].astype(np.float64)
    share = np.exp(-0.5 * ((x - 40) ** 2 / 9 + (y - 30) ** 2)).astype(np.float32)
    share += np.exp(-0.5 * ((x - 40) ** 2 + (y - 42) ** 2)).astype(np.float32)
    window = window_around(np.array([40.0, 30.0]), np.array([9.0, 0.0, 1.0]), share.shape)
    assert window is not None
    found = moments(share, window)
    assert found is not None
    np.testing.assert_allclose(found, [40, 30, 9, 0, 1], atol=5e-3)


def test_a_similarity_is_undone_exactly() -> None:
    rng = np.random.default_rng(3)
    points = rng.normal(size=(50, 3))
    turn = np.asarray(Rotation.from_rotvec([0.3, -0.2, 0.9]).as_matrix())
    scale, found, move = similarity(points, 1.7 * points @ turn.T + [4.0, 5.0, -6.0])
    assert scale == pytest.approx(1.7)
    np.testing.assert_allclose(found, turn, atol=1e-12)
    np.testing.assert_allclose(move, [4.0, 5.0, -6.0], atol=1e-12)


def test_a_mirror_image_is_not_taken_for_a_rotation() -> None:
    points = np.random.default_rng(4).normal(size=(50, 3))
    _, found, _ = similarity(points, points * [1.0, 1.0, -1.0])
    assert np.linalg.det(found) == pytest.approx(1.0)


def test_relative_error_leaves_out_what_was_not_measured() -> None:
    seen = np.full((4, 5, 3), 2.0, np.float32)
    predicted = seen * np.float32(1.01)
    predicted[0, 0] = np.nan
    mask = np.ones((4, 5), np.bool_)
    mask[1] = False
    predicted[1] = 99.0
    assert relative(predicted, seen, mask) == pytest.approx(0.01, rel=1e-4)


def test_rms_of_nothing_is_not_a_number() -> None:
    assert np.isnan(rms(np.array([np.nan])))


def test_development_of_even_light_changes_nothing() -> None:
    light = np.broadcast_to(np.array([0.2, 0.5, 0.8], np.float32), (12, 16, 3)).copy()
    np.testing.assert_allclose(developed(light, 1.0), light, atol=2e-5)
