"""The bundle adjustment against finite differences and scipy's least squares."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from controller.core.arrays import Float64
from controller.optics.calibrate.geometry import bundle_adjustment as ba


def tiny(seed: int, points: int = 14, noise_px: float = 0.1) -> tuple[ba.AdjustmentProblem, ba.AdjustmentState]:
    """A problem of two projectors with a known solution, made by the model under test (the stage tests do not)."""
    rng = np.random.default_rng(seed)
    state = ba.AdjustmentState(
        np.array([np.log(600.0), 190.0, 130.0, -0.05]),
        np.array([[np.log(500.0), 140.0, 220.0, 0.05], [np.log(560.0), 138.0, 215.0, -0.04]]),
        np.stack([_rotation(rng.normal([0.2, tilt, 0.0], 0.05)) for tilt in (0.4, -0.4)]),
        np.array([[-0.9, -0.1, 0.2], [1.0, 0.2, 0.1]]) + rng.normal(0, 0.05, (2, 3)),
        rng.uniform(0.4, 0.6, points),
    )
    state = ba.normalised(state)
    problem = ba.AdjustmentProblem(
        camera_px=rng.uniform([20, 20], [360, 240], (points, 2)),
        projector_px=np.zeros((points, 2, 2)),
        seen=np.ones((points, 2), dtype=np.bool_),
        camera_prior=state.camera.copy(),
        camera_sigma=np.array([0.01, 2.0, 2.0, 0.05]),
        projector_prior=state.intrinsics.copy(),
        projector_sigma=np.tile([0.5, 4.0, 60.0, 0.03], (2, 1)),
        noise_px=noise_px,
    )
    perfect = ba.residuals(problem, state)
    return replace(problem, projector_px=perfect + rng.normal(0, noise_px, perfect.shape)), state


def _rotation(vector: Float64) -> Float64:
    import cv2

    return np.asarray(cv2.Rodrigues(np.asarray(vector, dtype=np.float64))[0], dtype=np.float64)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_derivatives_are_those_of_finite_differences(seed: int) -> None:
    problem, state = tiny(seed)
    linear = ba.linearise(problem, state)
    for column in range(4 + 20):
        step = np.zeros(24)
        step[column] = h = 1e-6 if column not in (1, 2, 5, 6, 15, 16) else 1e-3
        ahead = ba.residuals(problem, ba.stepped(state, step, np.zeros(len(state.inverse_depth))))
        behind = ba.residuals(problem, ba.stepped(state, -step, np.zeros(len(state.inverse_depth))))
        expected = (ahead - behind) / (2 * h)
        ours = np.zeros_like(expected)
        if column < 4:
            ours = linear.by_camera[..., column]
        else:
            n, own = divmod(column - 4, 10)
            ours[:, n] = linear.by_projector[:, n, :, own]
        np.testing.assert_allclose(ours, expected, rtol=1e-4, atol=2e-4 * max(1.0, float(np.abs(expected).max())))
    nothing, every = np.zeros(24), np.full(len(state.inverse_depth), 1e-6)
    difference = ba.residuals(problem, ba.stepped(state, nothing, every)) - ba.residuals(
        problem, ba.stepped(state, nothing, -every)
    )
    np.testing.assert_allclose(linear.by_depth, difference / 2e-6, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_it_ends_where_scipy_ends(seed: int) -> None:
    problem, truth = tiny(seed)
    rng = np.random.default_rng(seed + 100)
    start = ba.normalised(ba.stepped(truth, rng.normal(0, 0.01, 24), rng.normal(0, 0.01, len(truth.inverse_depth))))

    def everything(x: Float64) -> Float64:
        state = ba.stepped(start, x[:24], x[24:])
        r = np.linalg.norm(ba.residuals(problem, state), axis=2).ravel() / problem.noise_px
        robust = 2.4 * np.sqrt(np.log1p((r / 2.4) ** 2))
        camera = (state.camera - problem.camera_prior) / problem.camera_sigma
        own = (state.intrinsics - problem.projector_prior) / problem.projector_sigma
        gauge = (np.mean(np.sum(state.centres**2, axis=1)) - 1) / 1e-3
        return np.concatenate([robust, camera, own.ravel(), [gauge]])

    solved = least_squares(everything, np.zeros(24 + len(truth.inverse_depth)), x_scale="jac", max_nfev=300)
    ours = ba.adjust(problem, start, iterations=200)
    assert ours.cost < 0.2 * ba.cost_of(problem, start)
    assert ours.cost <= solved.cost * (1 + 1e-3)


def test_the_covariance_is_that_of_the_full_normal_equations() -> None:
    problem, state = tiny(4, noise_px=1e-3)
    solved = ba.adjust(problem, state)
    linear = ba.linearise(problem, solved.state)
    points, projectors = problem.seen.shape
    whole = np.zeros((points, projectors, 2, 24 + points))
    whole[..., :4] = linear.by_camera
    for n in range(projectors):
        whole[:, n, :, 4 + 10 * n : 14 + 10 * n] = linear.by_projector[:, n]
    whole[np.arange(points), :, :, 24 + np.arange(points)] = linear.by_depth
    squared = np.sum(linear.residual_px**2, axis=2) / problem.noise_px**2
    whole *= (1 / np.sqrt(1 + squared / 2.4**2) / problem.noise_px)[..., None, None]
    rows = whole.reshape(-1, 24 + points)
    prior = np.zeros((13, 24 + points))
    prior[:4, :4] = np.diag(1 / problem.camera_sigma)
    for n in range(2):
        prior[4 + 4 * n : 8 + 4 * n, 4 + 10 * n : 8 + 10 * n] = np.diag(1 / problem.projector_sigma[n])
        prior[12, 11 + 10 * n : 14 + 10 * n] = solved.state.centres[n] / 1e-3
    rows = np.concatenate([rows, prior])
    scale = 1 / np.linalg.norm(rows, axis=0)
    expected = np.linalg.inv((rows * scale).T @ (rows * scale)) * np.outer(scale, scale)
    np.testing.assert_allclose(np.diag(solved.covariance), np.diag(expected)[:24], rtol=1e-2)


def test_scale_is_free_and_points_behind_a_projector_count_as_far_off() -> None:
    problem, state = tiny(5)
    doubled = replace(state, centres=2 * state.centres, inverse_depth=state.inverse_depth / 2)
    np.testing.assert_allclose(ba.residuals(problem, state), ba.residuals(problem, doubled), atol=1e-8)
    behind = replace(state, inverse_depth=np.full_like(state.inverse_depth, 50.0))
    assert np.isfinite(ba.cost_of(problem, behind))
    assert ba.cost_of(problem, behind) > ba.cost_of(problem, state)
