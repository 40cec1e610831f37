"""Curved patches: no bias on a ball, no pixel that sees two surfaces, no harm from wrong pixels."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from controller.optics.calibrate.geometry.surface_points import fit_patches, whole_pixels

FOCAL = 300.0


def ball(noise: float = 0.0) -> npt.NDArray[np.float32]:
    """(60, 80) inverse depths of a ball of 6 cm radius 1 m away before a wall at 1.3 m; the ball ends in the middle."""
    x, y = np.meshgrid((np.arange(80) - 40) / FOCAL, (np.arange(60) - 30) / FOCAL)
    inside = np.hypot(x, y) < 0.05
    depth = np.where(inside, 1.0 - np.sqrt(np.maximum(0.06**2 - x**2 - y**2, 0)) + 0.06, 1.3)
    return (1 / depth + np.random.default_rng(0).normal(0, noise, depth.shape)).astype(np.float32)


def test_a_balls_curve_is_kept() -> None:
    true = ball()
    smooth = fit_patches(true, whole_pixels(true, FOCAL), 2)
    near = np.s_[25:36, 35:46]
    assert np.abs(smooth[near] - true[near]).max() < 5e-5


def test_noise_is_lowered() -> None:
    noisy, true = ball(noise=1e-3), ball()
    smooth = fit_patches(noisy, whole_pixels(noisy, FOCAL), 2)
    near = np.s_[22:39, 32:49]
    assert np.std(smooth[near] - true[near]) < 0.6 * np.std(noisy[near] - true[near])


def test_pixels_at_an_edge_are_not_whole_and_neither_are_those_beside_them() -> None:
    true = ball()
    whole = whole_pixels(true, FOCAL)
    assert whole[30, 40]
    assert whole[30, 70]
    edge = int(np.flatnonzero(true[30, 40:] < 0.9)[0]) + 40  # the first pixel of the wall
    assert not whole[30, edge - 2 : edge + 2].any()
    assert whole[30, edge + 2]


def test_the_pictures_surface_ends_where_nothing_is_known() -> None:
    true = ball()
    true[:, 60:] = np.nan
    whole = whole_pixels(true, FOCAL)
    assert not whole[10, 58:].any()
    assert whole[10, 57]


def test_single_wrong_or_missing_pixels_do_no_harm() -> None:
    true = ball()
    damaged = true.copy()
    damaged[30, 41], damaged[27, 38], damaged[33, 36] = np.nan, 2.0, 0.2
    whole = whole_pixels(damaged, FOCAL)
    assert not whole[30, 41]
    assert not whole[27, 38]
    assert whole[30, 40]
    smooth = fit_patches(damaged, whole, 2)
    assert np.isnan(smooth[30, 41])
    assert np.isnan(smooth[27, 38])
    assert abs(smooth[30, 40] - true[30, 40]) < 5e-5
