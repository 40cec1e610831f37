"""The transport of plain frames at some camera pixels is that of the whole transport there."""

from __future__ import annotations

import numpy as np
import pytest

from controller.optics.transport.operator import SampledLight
from controller.optics.transport.planes import CameraBox


def sampled() -> SampledLight:
    rng = np.random.default_rng(3)
    mixing = (np.eye(3) + 0.1 * rng.random((2, 3, 3))).astype(np.float32)
    lit = rng.random((2, 5, 7)) > 0.3
    white = (rng.random((2, 3, 5, 7)) * lit[:, None]).astype(np.float32)
    return SampledLight.made(mixing, lit, white, (0.0, 0.2))


def test_forward_adjoint_and_matrix_are_one_operator() -> None:
    light, rng = sampled(), np.random.default_rng(4)
    p, r = rng.random((3, 2)).astype(np.float32), rng.random((3, 5, 7)).astype(np.float32)
    assert np.vdot(light.forward_planes(p), r) == pytest.approx(np.vdot(p, light.adjoint_planes(r)), rel=1e-5)
    matrix = light.submatrix(CameraBox(0, 0, 5, 7), np.arange(2), (0, 1, 2))
    np.testing.assert_allclose(matrix @ p.ravel(), light.forward_planes(p).ravel(), rtol=1e-5)
    only = light.forward_planes(p, projectors=(1, 2)) + light.forward_planes(p, projectors=(0, 1))
    np.testing.assert_allclose(only, light.forward_planes(p), rtol=1e-5)


def test_white_is_the_sum_of_the_projectors() -> None:
    light = sampled()
    together = sum(light.white[n] * light.mixing[n].sum(axis=1)[:, None, None] for n in range(2))
    np.testing.assert_allclose(np.moveaxis(light.reach(), 2, 0), together, rtol=1e-5)
    mean = light.gaussian_mean(np.ones((5, 7, 3), np.float32), 0)
    np.testing.assert_allclose(mean, 1, rtol=1e-5)
