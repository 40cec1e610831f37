"""Which camera pixels count how much."""

from __future__ import annotations

import numpy as np

from controller.optics.solve.bounded.equations import appearance_weights


def test_the_dark_counts_more_and_what_is_beyond_reach_counts_less() -> None:
    target = np.ones((2, 3, 3), np.float32) * np.array([[[0.8], [0.05], [0.8]]], np.float32)
    reachable = np.ones((2, 3), np.bool_)
    reachable[:, 2] = False
    weights = appearance_weights(target, reachable, 1.0)
    assert (weights[:, 1] > weights[:, 0]).all()
    assert (weights[:, 2] < weights[:, 0]).all()
    assert (weights > 0).all()


def test_weights_have_mean_one_whatever_the_exposure() -> None:
    target = np.random.default_rng(0).random((20, 30, 3)).astype(np.float32)
    reachable = np.ones((20, 30), np.bool_)
    bright, dim = (appearance_weights(target * np.float32(white), reachable, white) for white in (50.0, 0.1))
    np.testing.assert_allclose(bright, dim, rtol=1e-4)
    assert abs(float(bright.mean()) - 1) < 1e-5
