"""Reductions over channels are NumPy's."""

from __future__ import annotations

import numpy as np
import pytest

from controller.core import channels

PICTURE = np.random.default_rng(5).normal(size=(7, 11, 3)).astype(np.float32)
PICTURE[2, 3, 1], PICTURE[4, 5, 2] = np.nan, np.inf


@pytest.mark.parametrize("channel_count", [1, 2, 3, 4])
@pytest.mark.parametrize("shape", [(5, 6), (1, 1), (0, 4), (9,)])
def test_they_are_numpys_for_any_shape(shape: tuple[int, ...], channel_count: int) -> None:
    picture = np.random.default_rng(1).random((*shape, channel_count)).astype(np.float32)
    np.testing.assert_array_equal(channels.largest(picture), picture.max(axis=-1))
    np.testing.assert_array_equal(channels.smallest(picture), picture.min(axis=-1))
    np.testing.assert_allclose(channels.mean(picture), picture.mean(axis=-1), rtol=1e-6)
    np.testing.assert_allclose(channels.total(picture), picture.sum(axis=-1), rtol=1e-6)
    np.testing.assert_allclose(channels.length(picture), np.linalg.norm(picture, axis=-1), rtol=1e-6)
    products = (picture * (1 - picture)).reshape(-1, channel_count).sum(axis=0)
    np.testing.assert_allclose(channels.products(picture, 1 - picture), products, rtol=1e-5)
    np.testing.assert_array_equal(channels.every(picture > 0.3), (picture > 0.3).all(axis=-1))
    np.testing.assert_array_equal(channels.some(picture > 0.3), (picture > 0.3).any(axis=-1))


def test_what_is_not_finite_stays_so() -> None:
    np.testing.assert_array_equal(channels.largest(PICTURE), PICTURE.max(axis=2))
    np.testing.assert_array_equal(channels.smallest(PICTURE), PICTURE.min(axis=2))
    np.testing.assert_array_equal(channels.finite(PICTURE), np.isfinite(PICTURE).all(axis=2))
    assert channels.mean(PICTURE).dtype == np.float32
